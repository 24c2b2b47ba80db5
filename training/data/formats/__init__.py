"""Recordings in files: one module for each published format, and the checks that all of them share."""
