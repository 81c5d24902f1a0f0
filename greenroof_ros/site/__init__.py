"""What is built: the parameters of a site, its file, its clock and its horizon."""
