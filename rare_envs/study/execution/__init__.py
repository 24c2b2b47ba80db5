"""Simulations of a study: in chunks, from a journal, here or by workers."""
