"""Population based training (PBT), in which policies compare through a shared folder.

`observer` measures, decides and restarts during a training; `workspace` has the files, `mutation`
changes settings, and `restart` starts the process again.
"""
