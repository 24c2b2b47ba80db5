"""Columns of x one by one: their names and units, which are shown to a person, and scenarios by their digests."""

from __future__ import annotations

import hashlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rare_envs.distributions.space import ScenarioSpace
from samplers.problem import FloatArray

MAX_SHOWN = 12
"""Blocks of more values than this, drivers' weights and noise, are summarised instead of shown."""
ORDINARY_DRAWS = 4000
"""Scenarios drawn from the base distribution to show what is ordinary."""
LONGEST_KEY = 64
"""Bytes of a scenario that are its own digest."""


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
    blocks = zip(space.units, space.sizes, strict=True)
    about = [(unit, size <= MAX_SHOWN) for unit, size in blocks for _ in range(size)]
    return [Column(name, unit, shown) for name, (unit, shown) in zip(space.column_names, about, strict=True)]


def draw_ordinary(space: ScenarioSpace) -> FloatArray:
    """Return ordinary scenarios (n, d), the same on the console, in pictures and in the report."""
    return space.sample(ORDINARY_DRAWS, np.random.default_rng(0))


def find_ordinary_range(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends between which nine of ten ordinary values lie, of each column of (n, k)."""
    low, high = np.quantile(values, (0.05, 0.95), axis=0)
    return low, high


def format_value(value: float, places: int = 2) -> str:
    """Return a value with `places` decimals, or with two digits where these would be zeros (fog is 1e-4 per metre)."""
    return f"{value:.2g}" if 0.0 < abs(value) < 10.0**-places else f"{value:.{places}f}"


def digest_scenarios(x: NDArray[Any]) -> list[bytes]:
    """Return the digest of each of some scenarios x (n, d), in single precision, in which they are simulated."""
    rows = np.ascontiguousarray(x, dtype=np.float32)
    keys: list[bytes] = rows.view(f"V{4 * rows.shape[1]}").ravel().tolist()
    if 4 * rows.shape[1] <= LONGEST_KEY:
        return keys
    return [hashlib.blake2b(key, digest_size=16).digest() for key in keys]
