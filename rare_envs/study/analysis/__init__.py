"""Analyses of a finished evaluation: how severe its collisions are, and what p is sensitive to."""
