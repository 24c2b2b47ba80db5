"""Egos for tests, in a module that worker processes import quickly."""

from typing import Any

import numpy as np


class Always:
    """An ego that always does the same."""

    def __init__(self, action: Any) -> None:
        self.action = action

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        return np.repeat(np.array([self.action]), len(observation), axis=0), state
