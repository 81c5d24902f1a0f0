"""The nodes, one file and one process each."""
