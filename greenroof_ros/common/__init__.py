"""Code that every part shares: errors, files, command line, times, the interface."""
