"""Learned drivers: networks and the distribution of their weights, rules laid over their actions, and their files."""
