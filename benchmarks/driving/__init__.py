"""Benchmarks in traffic: realism of drivers, searches over them, egos."""
