"""Measures policies: pose error in metres, share of the skills, episodes without a fall."""
