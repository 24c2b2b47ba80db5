"""Benchmarks of two-stage alone."""
