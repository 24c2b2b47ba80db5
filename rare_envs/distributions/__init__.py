"""Distributions of scenario parameters and the spaces that they live on."""
