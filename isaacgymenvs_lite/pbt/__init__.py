"""Population based training (PBT), whose policies exchange objectives through a shared folder.

`observer` measures the objective and decides about restarts, `workspace` reads and writes the
shared files, `mutation` changes settings, and `restart` starts the process again.
"""
