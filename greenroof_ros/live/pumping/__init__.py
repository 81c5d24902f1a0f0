"""Safety of a real pump, without ROS and without a clock of its own: time is an argument."""
