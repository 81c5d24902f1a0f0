"""The nodes of a simulation: plant, weather, controller and recorder, each in its own module."""
