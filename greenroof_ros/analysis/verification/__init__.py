"""Forecasts compared with records: how good they are at different lead times."""
