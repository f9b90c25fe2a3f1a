"""Helpers that several packages share: rotations, files, threads, optional packages."""
