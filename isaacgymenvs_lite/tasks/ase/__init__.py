"""The humanoids of ASE: skills from a data set of clips, and goals to use them for."""
