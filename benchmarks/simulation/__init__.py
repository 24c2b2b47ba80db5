"""Benchmarks of simulation speed."""
