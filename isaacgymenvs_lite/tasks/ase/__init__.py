"""The humanoids of ASE learn skills from many clips and use them for goals."""
