"""The nodes of a simulation: plant, weather, controller and recorder, one class and file each."""
