"""Sizing of a cistern: volumes, targets and outlets, compared over all seasons of a record."""
