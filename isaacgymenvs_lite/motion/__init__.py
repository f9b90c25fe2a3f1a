"""Motion clips: files -> arrays -> states at a time (see docs/motion_formats.md)."""
