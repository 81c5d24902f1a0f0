"""What is made of runs and records: studies, reports, calibration, forecast scores; no ROS."""
