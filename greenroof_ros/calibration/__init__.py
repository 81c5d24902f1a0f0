"""Fitting a measured roof: records, wrong ones among them, the fit, its site file and its page."""
