"""Egos and drivers: the policies whose safety is estimated."""

from agents.ego import Ego, SavedEgo, load_ego

__all__ = ["Ego", "SavedEgo", "load_ego"]
