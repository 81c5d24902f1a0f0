"""What puts nodes into a graph: lockstep, parameters, processes."""
