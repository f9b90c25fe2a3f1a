"""Tasks in which a policy learns by imitating motion clips."""
