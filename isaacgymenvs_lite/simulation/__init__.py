"""Physics: the only package that steps a simulator. Tasks read and write batched tensors."""
