"""Columns of x one by one: their names and units, and which are shown to a person."""

from __future__ import annotations

from typing import NamedTuple

from rare_envs.distributions.space import ScenarioSpace

MAX_SHOWN = 12
"""Blocks of more values than this, drivers' weights and noise, are summarised instead of shown."""


class Column(NamedTuple):
    """One column of x."""

    name: str
    """The parameter's name; in a block with the number in it, such as "speed[0]"."""
    unit: str
    shown: bool
    """Whether the block is small enough to show its values."""

    @property
    def label(self) -> str:
        """Name and unit, for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def list_columns(space: ScenarioSpace) -> list[Column]:
    """Return the columns in the order of x."""
    return [
        Column(name if size == 1 else f"{name}[{k}]", unit, size <= MAX_SHOWN)
        for name, unit, size in zip(space.names, space.units, space.sizes, strict=True)
        for k in range(size)
    ]


def format_value(value: float, places: int = 2) -> str:
    """Return a value with `places` decimals, or with two digits where these would be zeros (fog is 1e-4 per metre)."""
    return f"{value:.2g}" if 0.0 < abs(value) < 10.0**-places else f"{value:.{places}f}"
