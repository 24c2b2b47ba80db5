"""Validation of a scenario before it is registered: a few episodes, one tick each."""

import torch
from torch import Tensor

from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.traffic.state import State

_DRAWS = 8
"""Episodes of the trial."""
_DT = 0.1
"""Its tick [s], the default of environments."""


def try_scenario(scenario: Scenario) -> None:
    """Start a few episodes and move the vehicles around the ego by one tick, by the script and by commands.

    Raises:
        ValueError: If a base distribution cannot be loaded, or something has the wrong shape or is not finite; the
            message says what.
    """
    import numpy as np

    for name in scenario.bases:
        load_base(scenario, name)
    x = torch.from_numpy(load_base(scenario).sample(_DRAWS, np.random.default_rng(0))).float()
    n = scenario.vehicles
    state = scenario.initial(x)
    if not isinstance(state, State):
        raise ValueError(
            f"Scenario {scenario.name!r}: expected initial(x) to give a State, got {type(state).__name__}."
        )
    _check(scenario, "initial(x)", state[:4], n)
    if len(state.theta) != _DRAWS:
        raise ValueError(
            f"Scenario {scenario.name!r}: expected theta of {_DRAWS} rows, got {tuple(state.theta.shape)}."
        )
    _check(scenario, "others(state, dt)", scenario.others(state, _DT), n - 1)
    _check(scenario, "driven(state, action, dt)", scenario.driven(state, _zero_action(state), _DT), n - 1)


def _zero_action(state: State) -> Tensor:
    """Return accelerations and yaw rates of 0 for the vehicles around the ego, shape (B, N - 1, 2)."""
    return torch.zeros_like(state.x[:, 1:, None]).expand(-1, -1, 2)


def _check(scenario: Scenario, what: str, fields: tuple[Tensor, ...], vehicles: int) -> None:
    """Check that fields are tensors (B, vehicles) of finite numbers."""
    if not isinstance(fields, tuple) or not all(isinstance(field, Tensor) for field in fields[:4]) or len(fields) < 4:
        raise ValueError(
            f"Scenario {scenario.name!r}: expected {what} to give x, y, heading and speed, as State or Others; "
            f"got {fields!r}."
        )
    for name, field in zip(State._fields, fields, strict=False):
        if field.shape != (_DRAWS, vehicles):
            raise ValueError(
                f"Scenario {scenario.name!r}: expected {name} of shape (B, {vehicles}) from {what}, got "
                f"{tuple(field.shape)} for B = {_DRAWS}."
            )
        if not bool(torch.isfinite(field).all()):
            raise ValueError(f"Scenario {scenario.name!r}: {name} from {what} is not finite.")
