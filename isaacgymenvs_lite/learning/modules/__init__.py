"""Networks and normalisers that several agents are built from."""
