"""Robots of users: reads any MJCF or URDF and adds what a task needs, without changing the file.

Start with `load_robot` in load.py.
"""
