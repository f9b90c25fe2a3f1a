"""rsl_rl: PPO, with critics that get the states of asymmetric tasks."""

from __future__ import annotations

from isaacgymenvs_lite.workflows.library import Library

LIBRARY = Library(
    name="rsl_rl",
    title="rsl_rl",
    package="rsl_rl",
    agent_class="RslRlAgent",
    checkpoints=("model_*.pt",),
)
