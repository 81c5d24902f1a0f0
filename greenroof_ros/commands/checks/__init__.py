"""Checks of nodes in other packages: whether they keep to the interface."""
