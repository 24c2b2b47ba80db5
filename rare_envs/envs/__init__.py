"""Gymnasium shells over the world."""
