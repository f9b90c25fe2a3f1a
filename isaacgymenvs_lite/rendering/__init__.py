"""Draws pictures and videos of robots without a screen."""
