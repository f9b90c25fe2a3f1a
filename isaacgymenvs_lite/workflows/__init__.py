"""Training and playing with other RL libraries, from the command line.

    isaacgymenvs-lite workflows sb3 train task=Cartpole num_envs=64
    isaacgymenvs-lite workflows sb3 play task=Cartpole

`training` is the story, `command` the command line, `agent_files` reads cfg/<library>/.
`sb3` (Stable-Baselines3), `skrl` and `rsl_rl` each make an agent of their library's classes.
"""
