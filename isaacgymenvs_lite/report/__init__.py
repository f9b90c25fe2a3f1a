"""Writes the report of a run: isaacgymenvs-lite report runs/<run>."""
