"""Recorded traffic: trajectory tables, smoothing, scenes and events."""
