"""Checks of nodes from other packages against the interface."""
