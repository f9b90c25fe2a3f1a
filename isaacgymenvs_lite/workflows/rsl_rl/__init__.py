"""PPO of rsl_rl on this package's tasks."""
