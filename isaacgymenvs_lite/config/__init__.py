"""The configuration: composed, checked, and turned into what rl_games loads.

`compose.compose` makes a tree, `launch.check_config` refuses a wrong one, and
`train_params.prepare_train_params` turns its train section into the dictionary of rl_games' Runner.
"""
