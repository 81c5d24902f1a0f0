"""A real site with its nodes, drives and sensors, and the supervisor that keeps it running."""
