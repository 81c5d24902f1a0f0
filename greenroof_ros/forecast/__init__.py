"""Forecasts: what a controller knows at each tick about the time ahead."""
