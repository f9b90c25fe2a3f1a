"""Latents of skills and the low-level policy that a high level steers."""
