"""Computes networks fast on CPUs: several threads compute different rows, in bfloat16."""
