"""What happened in a run: trajectories and bags."""
