"""PPO of Stable-Baselines3 on this package's tasks."""
