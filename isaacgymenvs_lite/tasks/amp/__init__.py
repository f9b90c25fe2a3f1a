"""Tasks that a policy learns by imitating motion clips."""
