"""Trained policies as files of other runtimes: isaacgymenvs-lite export."""
