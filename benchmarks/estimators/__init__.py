"""Benchmarks of the samplers: limit states, references, comparisons."""
