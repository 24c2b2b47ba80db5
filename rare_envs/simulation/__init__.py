"""Simulation: the world, its episodes, the time loop, observations and rewards."""

from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import Driver, World, drive

__all__ = ["Background", "Driver", "Episode", "TrafficBackground", "World", "drive"]
