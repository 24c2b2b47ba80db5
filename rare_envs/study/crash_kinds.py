"""What kinds of crash the failures of a run are: they are driven once more to see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

import samplers
from rare_envs import DrivingProblem
from rare_envs.egos.errors import EgoGone
from rare_envs.traffic.crash import describe_crash

LOOKED_AT = 10_000
"""Failing points that are driven again, evenly spaced among all."""
NAMES = MappingProxyType(
    {
        "rear_end": "the ego runs into a vehicle ahead",
        "rear_ended": "the ego is run into from behind",
        "side": "flank against flank",
        "road_edge": "the ego leaves the road",
        "others": "other vehicles collide",
        "none": "nobody collides",
        "no outcome": "the ego failed",
    }
)
"""Kinds of crash in words."""


@dataclass(frozen=True)
class Kinds:
    """What the failures of a run ended in."""

    shares: Mapping[str, samplers.Share] = field(default_factory=dict)
    """p by kind of crash; its parts add up to p. Empty if nothing failed, or it is not known."""
    listed: tuple[dict[str, Any] | None, ...] = ()
    """The crash of each failure of the list, see `rare_envs.traffic.crash.describe_crash`; empty if it is not known."""
    unknown: str = ""
    """Why it is not known."""


def look_again(problem: DrivingProblem, estimate: samplers.Estimate) -> Kinds:
    """Drive failures of a run once more: those of its list, and for the shares `LOOKED_AT` of all."""
    known = np.isfinite(estimate.failures.f)
    if not known.any():
        return Kinds()
    if problem.varies:
        return Kinds(unknown="the ego answers differently from run to run, so that its failures cannot be seen again")
    try:
        crashes = problem.crashes(estimate.failures.x[known])
        shares = {} if estimate.sample is None else estimate.shares(problem.crash_kinds, LOOKED_AT)
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's, and need not do again what it did before
        return Kinds(unknown=f"{type(error).__name__}: {error}")
    row = np.cumsum(known) - 1
    listed = (describe_crash(crashes, int(at)) if one else None for at, one in zip(row, known, strict=True))
    return Kinds(shares, tuple(listed))
