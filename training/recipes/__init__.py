"""Recipes: the bases and the road of the package from recordings."""
