"""Benchmarks of intervals that account for the events behind a base distribution."""
