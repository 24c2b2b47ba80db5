"""Egos for tests, in a module that worker processes import quickly."""

from typing import Any

import numpy as np


class Always:
    """An ego that always does the same."""

    def __init__(self, action: Any) -> None:
        self.action = action

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> Any:
        return np.array([self.action]), state


def faster() -> Always:
    return Always(3)
