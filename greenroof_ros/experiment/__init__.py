"""Runs, with their options, the closed loop in one process, lower bounds, and summaries."""
