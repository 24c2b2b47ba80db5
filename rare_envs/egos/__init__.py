"""Egos: policies as drivers, their inference in batches, their wrappers and their faults."""
