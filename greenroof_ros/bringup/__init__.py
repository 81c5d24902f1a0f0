"""The ways to run a graph: simulated, with a drive in the loop, and live."""
