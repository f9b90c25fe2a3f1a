"""Writes trained policies as files for other runtimes: isaacgymenvs-lite export."""
