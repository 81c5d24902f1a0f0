"""The nodes of a simulation: plant, weather, controller and recorder, a class and a file each."""
