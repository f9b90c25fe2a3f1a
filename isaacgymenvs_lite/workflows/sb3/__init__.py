"""Stable-Baselines3: PPO, in normalised environments where the agent file asks for it."""

from __future__ import annotations

from isaacgymenvs_lite.workflows.library import Library

LIBRARY = Library(
    name="sb3",
    title="Stable-Baselines3",
    package="stable_baselines3",
    agent_class="Sb3Agent",
    checkpoints=("checkpoints/model_*.zip", "model.zip"),
)
