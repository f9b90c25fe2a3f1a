"""Trained policies that ship with the project, and how they are packed and played by name."""
