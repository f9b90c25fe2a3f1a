"""Rough ground for legged robots: tiles, height scan and curriculum."""
