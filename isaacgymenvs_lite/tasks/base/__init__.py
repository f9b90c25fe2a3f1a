"""The life cycle that all tasks share."""
