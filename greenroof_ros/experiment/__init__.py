"""Runs and their options, the closed loop in a single process, lower bounds, and summaries."""
