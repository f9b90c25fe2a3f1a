"""Trains and plays agents of other RL libraries from the command line.

`__main__` reads the command line, `training` trains and plays agents, and `library` defines their
interface and reads agent files.
"""
