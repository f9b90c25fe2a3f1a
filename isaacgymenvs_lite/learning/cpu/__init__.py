"""Computes networks fast on CPUs: slices of rows on several threads, bfloat16."""
