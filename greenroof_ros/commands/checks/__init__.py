"""Checks of whether nodes from other packages conform to the interface."""
