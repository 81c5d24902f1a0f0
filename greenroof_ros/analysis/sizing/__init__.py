"""Size a cistern: compare many volumes, targets and outlets over all seasons of a record."""
