"""Shows people what a running graph does, on a page and in a terminal."""
