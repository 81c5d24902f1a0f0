"""Runs: options, the closed loop in one process, the clairvoyant bound, and summaries."""
