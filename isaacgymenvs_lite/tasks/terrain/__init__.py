"""Rough ground for legged robots."""
