"""Quantiles of columns of mixtures given the earlier ones: in plain numbers, by NumPy or compiled, or in logarithms."""
