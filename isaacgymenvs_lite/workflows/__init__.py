"""Training and playing with other RL libraries, from the command line.

    python -m isaacgymenvs_lite.workflows.sb3.train --task Cartpole --num_envs 64 --headless
    python -m isaacgymenvs_lite.workflows.sb3.play --task Cartpole --use_last_checkpoint

`sb3` (Stable-Baselines3), `skrl` and `rsl_rl` have a package each, which holds what is the
library's own: an agent made of its parts. Everything else stands here once.
"""
