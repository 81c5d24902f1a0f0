"""Forecasts: what a controller knows at every tick about the time ahead."""
