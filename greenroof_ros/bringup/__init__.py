"""Starting a graph, either of a simulated site or of a live site."""
