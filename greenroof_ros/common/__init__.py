"""Code that all parts share: errors, files, the command line, times and the interface."""
