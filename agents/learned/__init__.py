"""Learned drivers: networks, coloured noise, checkpoints and the distribution of their weights."""
