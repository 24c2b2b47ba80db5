"""Importance sampling from a fixed proposal, and the search for one."""
