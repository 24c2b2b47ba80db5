"""Saved Stable-Baselines3 policies, and how their files are opened safely."""
