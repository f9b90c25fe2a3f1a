"""A planner of moves that are no straight periodic gait: turns, side-steps, starts, stops, hops."""
