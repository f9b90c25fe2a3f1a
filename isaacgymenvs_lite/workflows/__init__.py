"""Training and playing with other RL libraries, from the command line.

`__main__` reads the command line, `training` is the story, and `library` has what both need of a
library.
"""
