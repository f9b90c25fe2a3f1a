"""The only package that steps a simulator; tasks see batched state tensors."""
