"""Rows of points in all coordinates of a mixture at once: what they have in common, their densities and maps."""
