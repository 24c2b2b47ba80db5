"""Benchmarks of trainings of egos."""
