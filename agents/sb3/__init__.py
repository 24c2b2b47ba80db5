"""Saved Stable-Baselines3 policies, and how their files are opened safely."""

from agents.sb3.file_trust import find_origin_risks
from agents.sb3.pickle_values import ForbiddenObject
from agents.sb3.safe_pickle import open_pickle
from agents.sb3.saved_ego import SavedEgo, load_saved_ego

__all__ = ["ForbiddenObject", "SavedEgo", "find_origin_risks", "load_saved_ego", "open_pickle"]
