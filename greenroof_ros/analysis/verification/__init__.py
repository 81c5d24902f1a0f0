"""Verification of forecasts: a comparison with records at different lead times."""
