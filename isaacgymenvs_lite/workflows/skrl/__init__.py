"""skrl: PPO, with critics that get the states of asymmetric tasks."""

from __future__ import annotations

from isaacgymenvs_lite.workflows.library import Library

LIBRARY = Library(
    name="skrl",
    title="skrl",
    package="skrl",
    agent_class="SkrlAgent",
    checkpoints=("checkpoints/agent_*.pt",),
)
