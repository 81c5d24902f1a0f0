"""Districts: many buildings with green roofs and cisterns, and their discharge to one sewer."""
