"""Generators of the shipped clips: gaits from tables, planned moves (docs/shipped_clips.md)."""
