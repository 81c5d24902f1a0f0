"""Forecasts: the information that a controller has about the weather ahead, in every tick."""
