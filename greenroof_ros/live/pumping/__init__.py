"""Safety of a real pump, independent of ROS and of any clock: time is passed as an argument."""
