"""Simulation: the world, its episodes, the time loop, observations and rewards."""

from rare_envs.simulation.background import Background, TrafficBackground
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.observation import Sensing, observe
from rare_envs.simulation.reward import RewardTerms, reward_terms
from rare_envs.simulation.rollout import Driver, drive
from rare_envs.simulation.world import World

__all__ = [
    "Background",
    "Clock",
    "Driver",
    "Episode",
    "Measurement",
    "RewardTerms",
    "Sensing",
    "TrafficBackground",
    "World",
    "drive",
    "observe",
    "reward_terms",
]
