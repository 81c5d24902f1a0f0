"""The ways to run a graph: simulated and live."""
