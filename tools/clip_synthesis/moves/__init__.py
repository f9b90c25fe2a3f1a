"""Plans moves that are not periodic gaits: turns, side-steps, starts, stops, hops."""
