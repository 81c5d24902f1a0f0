"""Studies: many runs that a grid defines, simulated in parallel, with one table of results."""
