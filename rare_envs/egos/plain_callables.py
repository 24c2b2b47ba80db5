"""Plain functions and torch modules as egos: observations in, actions out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.egos.validation import is_policy
from rare_envs.sensors.kinds import map_kinds


@dataclass(frozen=True)
class FunctionEgo:
    """A function from observations to actions as an ego.

    Example:
        >>> ego = FunctionEgo(lambda observation: np.tile([-0.4, 0.0], (len(observation), 1)))
        >>> ego.predict(np.zeros((2, 11)))[0].tolist()
        [[-0.4, 0.0], [-0.4, 0.0]]
    """

    function: Callable[[Any], Any]
    """Maps observations of B scenarios, (B, ...) or several of that kind by name, to actions, (B, 2) in [-1, 1] or
    whole numbers (B,)."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[Any], Any]:
        """Stable-Baselines3's `predict`; the function has no memory."""
        return np.asarray(self.function(observation)), state


@dataclass(frozen=True)
class ModuleEgo:
    """A torch module from observations to actions as an ego: in evaluation mode, without gradients, on its own device.

    Example:
        >>> ego = ModuleEgo(torch.nn.Linear(11, 2))
        >>> ego.predict(np.zeros((3, 11), np.float32))[0].shape
        (3, 2)
    """

    module: torch.nn.Module
    """Maps observations of B scenarios to actions, as the function of a `FunctionEgo`; float tensors in its dtype."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[NDArray[Any], Any]:
        """Stable-Baselines3's `predict`; the module has no memory."""
        self.module.eval()
        parameter = next(self.module.parameters(), torch.empty(0))
        shown = map_kinds(lambda part: torch.as_tensor(part).to(parameter), observation)
        with torch.no_grad():
            return self.module(shown).numpy(force=True), state

    def decide(self, observation: Any) -> torch.Tensor:
        """Return actions for observations of B rows, by the module on its own device."""
        self.module.eval()
        parameter = next(self.module.parameters(), torch.empty(0))
        with torch.no_grad():
            actions: torch.Tensor = self.module(map_kinds(lambda part: part.to(parameter), observation))
        return actions


def wrap_callable(ego: Any) -> Any:
    """Return a policy for a plain function or a torch module, and any other ego as it is.

    Example:
        >>> type(wrap_callable(torch.nn.Linear(11, 2))).__name__, wrap_callable("idm")
        ('ModuleEgo', 'idm')
    """
    if isinstance(ego, type) or not callable(ego) or is_policy(ego):
        return ego
    if any(hasattr(ego, name) for name in ("act", "in_world")):  # a driver, or an ego of worlds, that has __call__ too
        return ego
    return ModuleEgo(ego) if isinstance(ego, torch.nn.Module) else FunctionEgo(ego)
