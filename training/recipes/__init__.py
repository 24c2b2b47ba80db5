"""Recipes: how each file that is shipped was made, one script for each."""
