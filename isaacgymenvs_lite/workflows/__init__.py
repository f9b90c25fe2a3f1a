"""Trains and plays agents of other RL libraries from the command line.

`__main__` reads the command line, `training` trains and plays, and `library` defines the agents and
reads their files.
"""
