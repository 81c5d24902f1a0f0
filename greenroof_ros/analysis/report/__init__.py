"""Reports on the runs of studies, run directories and bags: figures, tables and a page."""
