"""How long, and how far, an episode stayed under a critical time to collision.

References:
    Minderhoud and Bovy, "Extended time-to-collision measures for road traffic safety assessment", Accident Analysis and
    Prevention 33, 2001.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from rare_envs.measures.base import Measure
from rare_envs.measures.moment import Moment
from rare_envs.measures.time_to_collision import ttc

TTC_CRITICAL = 3.0
"""Time to collision [s] under which an episode counts as exposed; Minderhoud and Bovy look at up to 4 s."""
EXPOSURE_MAX = 1000.0
"""Cap of what is added up [s or s^2]."""


@dataclass(frozen=True)
class Exposure(Measure):
    """Adds up over an episode: f is the critical value less the time integral of `of`, by rectangles of one tick."""

    critical: float = 1.0

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """Nothing has been added up yet."""
        return torch.full_like(moment.state.x[:, 0], self.critical)

    def update(self, kept: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Take one more tick from f."""
        f = (kept - self.of(moment) * moment.dt).clamp(min=self.critical - EXPOSURE_MAX)
        return self._ended(kept, f, moment, before, now)


def tet(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Time exposed time to collision (TET): how long the time to collision was under its critical value.

    The sum over ticks of their length where TTC < threshold; this is 1 at such a moment, else 0. It is a step of TTC,
    so its gradient is 0.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s under it is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        Share of the moment that is exposed, 0 or 1, shape (B,).
    """
    time = ttc(moment)
    return (time < threshold).to(time.dtype)


def tit(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Time integrated time to collision (TIT): the area between the critical time to collision and the TTC under it.

    The sum over ticks of (threshold - TTC) times their length where TTC < threshold; this is that height.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s^2 is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        By how much TTC is under the threshold [s], shape (B,).
    """
    return (threshold - ttc(moment)).clamp(min=0.0)
