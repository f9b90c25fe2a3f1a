"""Skill latents, and the low-level policy that a high-level policy controls through latents."""
