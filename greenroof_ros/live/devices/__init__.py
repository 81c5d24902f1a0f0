"""Drives and sensors on Modbus and MQTT; without ROS."""
