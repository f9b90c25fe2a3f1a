"""Population based training without an orchestrator: policies compare through a shared folder.

To read in this order: `population` decides who is replaced, `workspace` has the files, `mutation`
changes settings, `objective` measures a policy, `observer` does all of it during a training, and
`restart` starts the process again.
"""
