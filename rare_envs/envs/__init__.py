"""Environments: one scenario, batches, several agents, and their pictures.

Nothing is imported here: each environment needs a library of its own.
"""
