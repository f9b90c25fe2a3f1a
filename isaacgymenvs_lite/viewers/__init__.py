"""Looking on while an agent trains or plays: videos, a window, a page in a browser."""
