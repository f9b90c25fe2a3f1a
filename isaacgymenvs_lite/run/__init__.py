"""What belongs to one run: its folder, its stop, and the observers that show and log it.

The observers are rl_games' `AlgoObserver`s; `observers.TrainingObservers` holds all of them.
"""
