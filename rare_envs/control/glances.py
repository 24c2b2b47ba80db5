"""Glances of a driver away from the road: how long they last, and when they happen.

The distribution is that of ordinary driving in SHRP 2: 4,604 glances away from the road in 1,791 baseline epochs, coded
from video in steps of 0.1 s, the longest 6.7 s (described by Bargman et al., 2024). Its table is not published. It is
found here from the probabilities of the overshot that Imberg, Yang, Flannagan and Bargman published with their code
("Active sampling: a machine-learning-assisted framework for finite population inference with optimal subsamples", 2022,
github.com/imbhe/Active-Sampling, `Application/Data`): they put a glance of duration d over a moment so that it goes on
for 0, 0.1, ..., d s with equal probabilities, so the number of glances of duration d is proportional to
(d / 0.1 + 1) times the difference of neighbouring probabilities. All counts above 2 s come out whole, 4,608 in all.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.devices import constant

GLANCE_CDF: Final = (
    (0.05, 0.0),
    (0.15, 0.0048),
    (0.25, 0.0206),
    (0.35, 0.0736),
    (0.45, 0.1805),
    (0.55, 0.2905),
    (0.65, 0.4307),
    (0.75, 0.5220),
    (0.85, 0.6158),
    (0.95, 0.6845),
    (1.05, 0.7468),
    (1.25, 0.8234),
    (1.45, 0.8859),
    (1.75, 0.9345),
    (2.05, 0.9640),
    (2.45, 0.9824),
    (2.95, 0.9922),
    (3.45, 0.9974),
    (4.15, 0.9993),
    (6.65, 1.0),
)
"""Duration of a glance away from the road [s] and share of the glances that are no longer; linear in between."""
OFF_ROAD_SHARE: Final = 0.1665
"""Share of the time for which the eyes are off the road, from the same source. (About 20 % in Morando, Victor and
Dozza, "A Bayesian reference model for visual time-sharing behaviour in manual and automated naturalistic driving",
2019.)"""
MEAN_GLANCE: Final = sum((d1 + d0) / 2 * (p1 - p0) for (d0, p0), (d1, p1) in pairwise(GLANCE_CDF))
"""Mean duration of a glance away from the road [s], 0.866."""
MEAN_ON_ROAD: Final = MEAN_GLANCE * (1.0 - OFF_ROAD_SHARE) / OFF_ROAD_SHARE
"""Mean time between two such glances [s], 4.3: what gives the share."""
MOST_URGENT_GLANCE: Final = 0.2
"""No glance is begun where the lead comes nearer by more than this share of its distance in a second [1/s], a time to
collision of 5 s: that drivers then keep their eyes on the road is an assumption of the crash causation model of Bargman
et al. (2024), after Victor et al. ("Analysis of naturalistic driving study data: safer glances", SHRP 2, 2015)."""
START_DRAWS: Final = 2
"""Draws of how an episode begins: whether with the eyes off the road, and for how long still."""


class Glances(NamedTuple):
    """Glances away from the road of B drivers, G each, in their order; one that starts where it ends is none."""

    start: Tensor
    """[s] since the episode began, shape (B, G)."""
    end: Tensor
    """[s], shape (B, G)."""

    def off_road(self, time: float) -> Tensor:
        """Return whose eyes are off the road at a time [s], boolean, shape (B,)."""
        return ((self.start <= time) & (time < self.end)).any(dim=1)

    def number_at(self, time: float) -> Tensor:
        """Return how many have begun by a time [s], int64, shape (B,)."""
        return (self.start <= time).sum(dim=1)


def count_glances(horizon: float) -> int:
    """Return how many glances are drawn for an episode [s]: five standard deviations more than begin on average.

    Example:
        >>> count_glances(10.0)
        12
    """
    mean = horizon / MEAN_ON_ROAD
    return math.ceil(mean + 5.0 * math.sqrt(mean) + 2.0)


def count_glance_draws(horizon: float) -> int:
    """Return how many standard normal draws the glances of an episode [s] take."""
    return START_DRAWS + 2 * count_glances(horizon)


def glance_duration(share: Tensor) -> Tensor:
    """Return the duration [s] that a share of all glances does not exceed: the quantile function, any shape.

    Example:
        >>> glance_duration(torch.tensor([0.5, 0.95])).round(decimals=2)  # median, 95 %
        tensor([0.7300, 1.9100])
    """
    return _interpolate(share, [p for _, p in GLANCE_CDF], [d for d, _ in GLANCE_CDF])


def remaining_duration(share: Tensor) -> Tensor:
    """Return the same quantile of what is left of a glance at a moment at which the eyes are off the road [s].

    In a stationary sequence it has the density P[duration > r] / mean duration (Cox, "Renewal theory", 1962).
    """
    time, probability = np.linspace(0.0, GLANCE_CDF[-1][0], 268), np.array(GLANCE_CDF)
    longer = 1.0 - np.interp(time, probability[:, 0], probability[:, 1])
    cdf = np.concatenate(([0.0], np.cumsum((longer[1:] + longer[:-1]) / 2 * np.diff(time))))
    return _interpolate(share, (cdf / cdf[-1]).tolist(), time.tolist())


def draw_glances(draws: Tensor) -> Glances:
    """Return the glances of B drivers: a stationary sequence.

    Times between glances are exponential, as in the simulations of Rootzen and Zholud ("Tail estimation for
    window-censored processes", Technometrics 58, 2016).

    Args:
        draws: Standard normal, shape (B, `count_glance_draws(horizon)`).
    """
    share = torch.special.ndtr(draws).clamp(1e-7, 1.0 - 1e-7)
    left = torch.where(share[:, 0] < OFF_ROAD_SHARE, remaining_duration(share[:, 1]), 0.0)[:, None]
    between, lasting = -MEAN_ON_ROAD * torch.log1p(-share[:, START_DRAWS::2]), glance_duration(share[:, 3::2])
    end = left + (between + lasting).cumsum(dim=1)
    return Glances(torch.cat((torch.zeros_like(left), end - lasting), dim=1), torch.cat((left, end), dim=1))


def _interpolate(value: Tensor, known: list[float], result: list[float]) -> Tensor:
    """Return piecewise linear interpolation between increasing `known` values, as `numpy.interp`."""
    x, y = constant(tuple(known), value), constant(tuple(result), value)
    right = torch.searchsorted(x, value.contiguous()).clamp(1, len(known) - 1)
    share = ((value - x[right - 1]) / (x[right] - x[right - 1])).clamp(0.0, 1.0)
    return y[right - 1] + share * (y[right] - y[right - 1])
