"""Benchmark of samplers from the command line: scenarios of the package among its problems, runs in files, a page."""
