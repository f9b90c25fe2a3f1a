"""Replaces IsaacGymEnvs' package `tasks.amp.utils_amp`; `module_names` maps its modules."""
