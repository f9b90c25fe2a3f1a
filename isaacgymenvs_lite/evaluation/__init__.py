"""Measures what a policy can do: pose error in metres, skills, episodes without a fall."""
