"""Helpers for rotations, files, threads and optional packages that several packages share."""
