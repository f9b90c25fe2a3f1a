"""The commands check, demo, policies and alias."""
