"""Readers and writers of motion files, one module for each format."""
