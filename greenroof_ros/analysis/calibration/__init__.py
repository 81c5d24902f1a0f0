"""Calibration of field-capacity soil and pumps: records, checks, fits, site file and page."""
