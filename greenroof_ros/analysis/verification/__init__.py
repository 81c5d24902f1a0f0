"""Forecasts compared with records: how good they are at each lead time."""
