"""IsaacGymEnvs' helper modules by their names, for scripts that import them (see `alias`)."""
