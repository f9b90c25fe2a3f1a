"""Reads, checks and writes checkpoints, and packs the policies that ship with the project."""
