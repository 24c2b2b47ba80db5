"""Simulation: the world, its episodes, the rollout, observations and rewards."""
