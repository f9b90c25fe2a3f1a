"""Domain randomisation: noise on observations and actions, models that differ."""
