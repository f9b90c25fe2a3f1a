"""PPO of skrl on this package's tasks."""
