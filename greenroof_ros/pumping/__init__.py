"""What keeps a real pump safe, without ROS and without a clock: time is an argument."""
