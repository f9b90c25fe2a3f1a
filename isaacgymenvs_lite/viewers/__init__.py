"""Shows a training or a play in videos, in a window, or on a page in a browser."""
