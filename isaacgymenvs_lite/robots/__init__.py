"""Reads a user's robot (MJCF or URDF) and adds what a task needs, without changing the file.

Start reading with `load_robot` in load.py.
"""
