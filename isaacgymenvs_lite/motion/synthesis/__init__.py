"""Generators of the shipped clips: gaits from published data, planned moves (docs/shipped_clips.md)."""
