"""Spaces of policies: the observation and the actions that they fit, and the check of a choice."""
