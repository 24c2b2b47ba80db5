"""Shipped bases: the recorded events that those of the package are fitted to, and how often these happen."""
