"""Districts: many buildings with green roofs and cisterns, and what they send to one sewer."""
