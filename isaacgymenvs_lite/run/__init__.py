"""The folder of a run, its stop request, and the observers that show and log a training.

The observers are rl_games' `AlgoObserver`s; `observers.TrainingObservers` combines them.
"""
