"""Rare events on the curved highway, in 428 and 1,448 dimensions: their probabilities, and what methods gain there."""
