"""Shows a task, during a training or while a policy plays, in videos, a window or a browser."""
