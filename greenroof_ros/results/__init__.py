"""What a run leaves: metrics, tables, trajectories and bags."""
