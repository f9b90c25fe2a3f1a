"""Replaces IsaacGymEnvs' package `tasks.amp.utils_amp`, whose modules have other names here."""
