"""Budget: simulations for a wished coefficient of variation, from a pilot.

A method that goes on drawing until it meets a target (two-stage, cross-entropy, importance sampling, Monte Carlo) has
made a search of S simulations and then n draws with the c.o.v. c0. The variance of these falls as 1 / n, so that

    N(c) = S + n (c0 / c)^2

is its cost with `target_cov=c`, if the pilot had the method's own budget and so the same search. A method of single
runs (subset simulation) is repeated: N(c) = N0 (c0 / c)^2, but at least 5 runs. Plain Monte Carlo needs
(1 - p) / (p c^2).

The pilot knows its own c.o.v. to a few ten per cent, and another seed finds another proposal: a plan
is right within a factor of about 2.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from samplers.serialization import to_json_value
from samplers.validation import check_number

MAX_PILOT_COV = 0.5
"""C.o.v. of a pilot from which it tells too little: its own error is then of the order of a factor of 2."""
MIN_RUNS = 5
"""Single runs that are made at least where one misses the target."""


@dataclass(frozen=True, kw_only=True)
class Pilot:
    """A run from which others are planned.

    Raises:
        ValueError: It found no failure, or knows p too badly.

    Example:
        >>> Pilot(method="mc", p=1e-3, cov=0.9, n_sim=1200, final_draws=1200)
        Traceback (most recent call last):
            ...
        ValueError: The pilot of 1,200 simulations has a c.o.v. of 0.9: above 0.5 it tells too little; a plan needs a larger one.
    """  # noqa: E501 (the example shows a whole message)

    method: str
    """Name of its method."""
    p: float
    """Estimated probability."""
    cov: float
    """Its coefficient of variation."""
    n_sim: int
    """Simulations, search included."""
    final_draws: int | None
    """Draws behind p, if the method goes on with them until a target is met; None if it makes further runs."""
    seconds: float | None = None
    """Wall time [s], where it is known."""

    def __post_init__(self) -> None:
        """Check that there is something to plan from."""
        if not self.p > 0.0:
            raise ValueError(f"The pilot of {self.n_sim:,} simulations found no failure: a plan needs a larger one.")
        if not 0.0 < self.cov <= MAX_PILOT_COV:
            raise ValueError(
                f"The pilot of {self.n_sim:,} simulations has a c.o.v. of {self.cov:.2g}: above {MAX_PILOT_COV} it "
                "tells too little; a plan needs a larger one."
            )


@dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """Simulations that a method needs for a coefficient of variation.

    Example:
        >>> PlannedRun(method="mc", target_cov=0.1, n_sim=99_900).to_dict()
        {'method': 'mc', 'target_cov': 0.1, 'n_sim': 99900, 'seconds': None}
    """

    method: str
    """Name of the method."""
    target_cov: float
    """Coefficient of variation that is wished for: `target_cov` of `estimate`."""
    n_sim: int
    """Simulations, those of a search included."""
    seconds: float | None = None
    """Wall time [s], if the pilot's is known."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {name: to_json_value(value) for name, value in asdict(self).items()}


def plan_runs(pilot: Pilot, target_cov: float) -> tuple[PlannedRun, ...]:
    """Return what the method of a pilot needs, and plain Monte Carlo.

    Args:
        pilot: The pilot.
        target_cov: Coefficient of variation that is wished for.

    Raises:
        ValueError: If the target is not above 0.

    Example:
        >>> pilot = Pilot(method="two-stage", p=1e-4, cov=0.02, n_sim=6000, final_draws=2000, seconds=12.0)
        >>> [(run.method, run.n_sim, run.seconds) for run in plan_runs(pilot, target_cov=0.01)]
        [('two-stage', 12000, 24.0), ('mc', 99990000, 199980.0)]
    """
    check_number("target_cov", target_cov, 0.0, math.inf)
    needed = {pilot.method: _own_cost(pilot, target_cov), "mc": (1.0 - pilot.p) / (pilot.p * target_cov**2)}
    rate = None if pilot.seconds is None else pilot.seconds / pilot.n_sim
    counts = {name: max(1, math.ceil(n * (1.0 - 1e-12))) for name, n in needed.items()}  # rounding of the division
    return tuple(
        PlannedRun(method=name, target_cov=float(target_cov), n_sim=n, seconds=None if rate is None else rate * n)
        for name, n in counts.items()
    )


def _own_cost(pilot: Pilot, target_cov: float) -> float:
    """Return the simulations of the pilot's own method."""
    factor = (pilot.cov / target_cov) ** 2
    if pilot.final_draws is not None:
        return pilot.n_sim - pilot.final_draws + pilot.final_draws * factor
    return float(pilot.n_sim) * (1.0 if factor <= 1.0 else max(MIN_RUNS, math.ceil(factor)))
