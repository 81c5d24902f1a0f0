"""Records of a run: trajectories, bags, and tables of results and rain events."""
