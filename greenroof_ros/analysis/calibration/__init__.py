"""Fitting a measured soil and the pumps: records, checks of records, fits, site file, page."""
