"""Devices: where torch simulates, and what values on them cost to make and to look at."""

from rare_envs.devices.names import find_device
from rare_envs.devices.values import are_zero, can_look, constant, fixed_draws, indices, may_hold, move_to, scalars

__all__ = [
    "are_zero",
    "can_look",
    "constant",
    "find_device",
    "fixed_draws",
    "indices",
    "may_hold",
    "move_to",
    "scalars",
]
