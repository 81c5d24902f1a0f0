"""Analyses without ROS: studies, reports, sizing, districts, calibration and forecast scores."""
