"""Calibration of field-capacity soil: records, fits, site file and page."""
