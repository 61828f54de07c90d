"""The page: a guided session and the workbench in a browser, served on this machine alone."""
