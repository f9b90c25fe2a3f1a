"""Reads a user's robot (MJCF or URDF) and adds what a task needs; the file does not change.

Start reading with `load_robot` in load.py.
"""
