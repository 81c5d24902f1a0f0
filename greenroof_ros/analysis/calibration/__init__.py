"""Fitting field-capacity soil and the pumps: records, their checks, fits, site file and page."""
