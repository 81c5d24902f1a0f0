"""What a running graph does, for people who look at it: on a page and in a terminal."""
