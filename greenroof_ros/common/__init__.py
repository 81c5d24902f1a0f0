"""Code shared by all parts of the package: errors, files, command line, times and interface."""
