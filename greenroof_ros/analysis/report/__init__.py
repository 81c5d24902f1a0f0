"""Reports on runs: figures, tables and one page, from a study, run directories or bags."""
