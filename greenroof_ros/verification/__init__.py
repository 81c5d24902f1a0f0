"""Forecasts compared with records: how much they are worth, by how far ahead they look."""
