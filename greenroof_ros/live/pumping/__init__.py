"""Safety of a real pump, without ROS and without a clock: time is an argument."""
