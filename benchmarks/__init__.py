"""Measurements: ratios of interleaved runs, never asserted in tests."""
