"""Drivers for drives and sensors on Modbus and MQTT, independent of ROS."""
