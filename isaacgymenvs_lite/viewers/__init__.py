"""Viewers of a training or a play: videos, a window, a page in a browser."""
