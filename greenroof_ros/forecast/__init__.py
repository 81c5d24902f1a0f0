"""Forecasts: the information of a controller about the time ahead, in every tick."""
