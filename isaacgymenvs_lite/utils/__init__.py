"""Helpers without state: rotations and the tensor arithmetic that tasks share."""
