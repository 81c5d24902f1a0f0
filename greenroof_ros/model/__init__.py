"""Site and plant: Eqs. (1)-(10) of the paper, and what a run is judged by."""
