"""Fitting a measured roof and its pumps: records, wrong ones among them, fits, site file, page."""
