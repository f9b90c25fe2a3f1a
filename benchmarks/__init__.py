"""Benchmarks of speed, memory and learning; the tests assert none of their results."""
