"""Rough ground for legged robots: its tiles, what is seen of it, where to go next."""
