"""Drives and sensors by Modbus; no ROS."""
