"""Checks of whether nodes in other packages keep to the interface."""
