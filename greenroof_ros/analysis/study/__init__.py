"""Studies: many runs from one grid, in parallel, and their results in one table."""
