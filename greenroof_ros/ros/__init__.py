"""Parts of a graph's nodes: messages, publishers, parameters, reports, lockstep, executables."""
