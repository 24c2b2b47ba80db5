"""Exposure: how long, and by how much, an episode stayed under a critical time to collision.

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
    """A measure that adds up over an episode: f is the critical value less the time integral of `of`.

    The integral is a sum of rectangles of one tick.

    Example:
        >>> import rare_envs
        >>> slow = Exposure(lambda moment: (moment.state.speed[:, 0] < 19.9).float(), critical=2.0)
        >>> problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=slow)
        >>> problem.evaluate([[20.0, 10.0, 150.0]]).round(1).tolist()  # 6.5 s of the 10 s
        [-4.5]
    """

    critical: float = 1.0

    def start(self, moment: Moment, ticks: int) -> Tensor:
        """Return the critical value: nothing has been added up yet."""
        return torch.full_like(moment.state.x[:, 0], self.critical)

    def update(self, state: Tensor, moment: Moment, before: Tensor, now: Tensor) -> Tensor:
        """Return f less one more tick."""
        f = (state - self.of(moment) * moment.dt).clamp(min=self.critical - EXPOSURE_MAX)
        return self._with_collisions(state, f, moment, before, now)


def tet(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time exposed time-to-collision (TET), 1 where TTC is under its critical value.

    TET is the time for which TTC < threshold: the sum of the lengths of such ticks. The integrand is a step of TTC, so
    its gradient is 0.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s under it is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        Share of the moment that is exposed, 0 or 1, shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> tet(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # TTC 2.5 s
        1.0
    """
    time = ttc(moment)
    return (time < threshold).to(time.dtype)


def tit(moment: Moment, threshold: float = TTC_CRITICAL) -> Tensor:
    """Return the integrand of the time integrated time-to-collision (TIT), by how much TTC is under its critical value.

    TIT is the area between the threshold and the TTC under it: the sum over ticks of (threshold - TTC) times their
    length where TTC < threshold.

    Critical value: 3 s of TTC is the threshold here; that an episode has failed with 1 s^2 is our choice.

    Args:
        moment: Of B scenarios.
        threshold: Critical time to collision [s].

    Returns:
        By how much TTC is under the threshold [s], shape (B,).

    Example:
        >>> from rare_envs.measures import Moment
        >>> tit(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # TTC 2.5 s
        0.5
    """
    return (threshold - ttc(moment)).clamp(min=0.0)
