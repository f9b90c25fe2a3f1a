"""Generators of the shipped clips (docs/shipped_clips.md): gaits from tables, planned moves."""
