"""Simulation: the world, its episodes, the time loop, observations and rewards."""

from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import Driver, drive
from rare_envs.simulation.world import World

__all__ = ["Background", "Driver", "Episode", "TrafficBackground", "World", "drive"]
