"""Analyses of an estimate without new simulations: other thresholds, other base distributions, kinds of failure."""
