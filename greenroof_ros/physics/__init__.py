"""The plant: numbers in, numbers out."""
