"""Which cistern: many sizes, targets and outlets over all seasons of a record."""
