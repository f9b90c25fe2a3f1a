"""Composes and checks the configuration.

`compose.compose` makes a tree, `launch.read_config` checks it, and
`train_params.prepare_train_params` turns the train section into the dictionary of rl_games' Runner.
"""
