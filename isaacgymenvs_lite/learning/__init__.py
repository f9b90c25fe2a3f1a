"""Agents, players, models, networks, buffers and losses on top of rl_games.

rl_games' training loop calls `play_steps`, `train_epoch` and `calc_gradients`: each exists once, in
`CommonAgent`, with hooks for what an agent does differently.
"""
