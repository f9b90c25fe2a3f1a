"""Domain randomisation: noise on observations and actions, and randomised models."""
