"""Studies: many runs from one grid, in parallel, and what came of them in one table."""
