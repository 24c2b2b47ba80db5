"""Recipes: the bases and the road of the package from recordings, and the model card of its drivers."""
