"""The site and the plant, Eqs. (1)-(10) of the paper, and the metrics of a run."""
