"""The nodes of a simulation, and the checks of controllers and pump drivers from elsewhere."""
