"""Fitting a measured roof and its pumps: records, checks of records, fits, site file, page."""
