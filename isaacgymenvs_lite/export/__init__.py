"""Trained policies as files of other runtimes: python -m isaacgymenvs_lite.export."""
