"""Tools that know no roof: errors, parameters, files, times, processes and the command line."""
