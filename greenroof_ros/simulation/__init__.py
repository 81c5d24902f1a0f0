"""One run without ROS."""
