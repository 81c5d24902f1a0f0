"""Records of a run: trajectories and bags."""
