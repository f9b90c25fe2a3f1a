"""Stable-Baselines3: PPO, with observations and rewards normalised if the agent file says so."""

from __future__ import annotations

from isaacgymenvs_lite.workflows.library import Library

LIBRARY = Library(
    name="sb3",
    title="Stable-Baselines3",
    package="stable_baselines3",
    agent_class="Sb3Agent",
    checkpoints=("checkpoints/model_*.zip", "model.zip"),
)
