"""Replaces the package `tasks.amp.utils_amp` of IsaacGymEnvs; its modules are elsewhere here."""
