"""One evaluation as a user runs it: the command line, the run directory and its pictures."""
