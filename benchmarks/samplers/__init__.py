"""Benchmark of samplers: problems with known probabilities, any method on them many times, and what the runs show."""
