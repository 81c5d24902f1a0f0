"""A green roof watered from a storm cistern, as a ROS 2 node graph and as a library without ROS."""

__version__ = "1.0.0"
