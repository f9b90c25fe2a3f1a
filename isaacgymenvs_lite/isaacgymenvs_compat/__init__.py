"""Modules with the names of IsaacGymEnvs' helper modules, for scripts that import these names."""
