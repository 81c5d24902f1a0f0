"""Safety of a real pump, independent of ROS."""
