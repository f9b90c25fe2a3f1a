"""Reads motion clips, and computes states at any time (see docs/motion_formats.md)."""
