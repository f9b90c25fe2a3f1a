"""Shape and dtype adapters between our tasks and RL libraries, nothing else."""
