"""Agents, players, models, networks, buffers and losses on top of rl_games."""
