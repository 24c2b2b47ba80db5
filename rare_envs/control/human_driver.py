"""The human driver model of Treiber, Kesting and Helbing, with published limits of perception and braking; and glances.

Reaction time, errors of estimation and anticipation around the Intelligent Driver Model. Everything here is a formula
of what the driver has seen; `rare_envs.egos.human` adds the memory that makes an ego of it.

Glances away from the road: 4,604 of 1,791 baseline epochs of SHRP 2, coded from video in steps of 0.1 s, the longest
6.7 s. Their table is not published. It is found from the probabilities of the overshot of Imberg et al. (2022,
github.com/imbhe/Active-Sampling, `Application/Data`): they put a glance of duration d over a moment so that it goes on
for 0, 0.1, ..., d s with equal probabilities, so the number of glances of duration d is proportional to (d / 0.1 + 1)
times the difference of neighbouring probabilities. All counts above 2 s come out whole, 4,608 in all.

References:
    Treiber, Kesting and Helbing, "Delays, inaccuracies and anticipation in microscopic traffic models", Physica A 360,
    2006; Treiber and Kesting, "Traffic Flow Dynamics", Springer, 2013, chapter 12; Bargman et al., 2024.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.devices import constant
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import NEAR_ZERO, STANDARD_GRAVITY, VEHICLE_LENGTH, State

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


def count_glance_draws(horizon: float) -> int:
    """Return how many standard normal draws the glances of an episode [s] take: 5 deviations more than begin."""
    mean = horizon / MEAN_ON_ROAD
    return START_DRAWS + 2 * math.ceil(mean + 5.0 * math.sqrt(mean) + 2.0)


def remaining_duration(share: Tensor) -> Tensor:
    """Return the quantile of what is left of a glance at a moment of eyes off the road [s], by shares (B,).

    In a stationary sequence it has the density P[duration > r] / mean duration (Cox, "Renewal theory", 1962).
    """
    time, probability = np.linspace(0.0, GLANCE_CDF[-1][0], 268), np.array(GLANCE_CDF)
    longer = 1.0 - np.interp(time, probability[:, 0], probability[:, 1])
    cdf = np.concatenate(([0.0], np.cumsum((longer[1:] + longer[:-1]) / 2 * np.diff(time))))
    return _interpolate(share, tuple((cdf / cdf[-1]).tolist()), tuple(time.tolist()))


def draw_glances(draws: Tensor) -> Glances:
    """Return the glances of B drivers, a stationary sequence, from standard normal draws (B, `count_glance_draws`).

    Times between them are exponential (Rootzen and Zholud, "Tail estimation for window-censored processes", 2016).
    """
    share = torch.special.ndtr(draws).clamp(1e-7, 1.0 - 1e-7)
    left = torch.where(share[:, 0] < OFF_ROAD_SHARE, remaining_duration(share[:, 1]), 0.0)[:, None]
    duration, no_longer = zip(*GLANCE_CDF, strict=True)
    between = -MEAN_ON_ROAD * torch.log1p(-share[:, START_DRAWS::2])
    lasting = _interpolate(share[:, 3::2], no_longer, duration)
    end = left + (between + lasting).cumsum(dim=1)
    return Glances(torch.cat((torch.zeros_like(left), end - lasting), dim=1), torch.cat((left, end), dim=1))


def _interpolate(value: Tensor, known: tuple[float, ...], result: tuple[float, ...]) -> Tensor:
    """Return piecewise linear interpolation between increasing `known` values, as `numpy.interp`."""
    x, y = constant(known, value), constant(result, value)
    right = torch.searchsorted(x, value.contiguous()).clamp(1, len(known) - 1)
    share = ((value - x[right - 1]) / (x[right] - x[right - 1])).clamp(0.0, 1.0)
    return y[right - 1] + share * (y[right] - y[right - 1])


MAX_HUMAN_BRAKING = 0.774 * STANDARD_GRAVITY
"""Hardest braking of a competent and careful human driver [m/s^2]: UN Regulation 157, as its reference implementation
(esmini) has it, which all values of this regulation below are from."""


ATTENTIVE_IDM: Final = IDM(
    desired_speed=120.0 / 3.6,
    time_headway=1.0,
    max_acceleration=1.0,
    comfortable_deceleration=1.5,
    jam_distance=2.0,
    jam_distance_speed=0.0,
    max_deceleration=MAX_HUMAN_BRAKING,
    cut_off=True,
)
"""The IDM of motorways: Treiber and Kesting (2013), table 11.2, its values as commonly quoted."""


class Percept(NamedTuple):
    """What a driver knows of V other vehicles at a moment, in B scenarios; shape (B, V) each."""

    distance: Tensor
    """From centre to centre along the road [m], positive ahead."""
    speed: Tensor
    """Of the other vehicle along the driver's heading [m/s]."""
    noticed: Tensor
    """Whether the driver takes it for one that it follows, boolean."""


@dataclass(frozen=True)
class HumanDriverModel:
    """Parameters of an attentive human driver; each is published, none is fitted.

    Values of the book and of Regulation 157 are as quoted or implemented in public; neither text was consulted.
    """

    idm: IDM = ATTENTIVE_IDM
    """How the driver wants to drive."""
    reaction_time: float = 0.6
    """T' [s]: Treiber and Kesting (2013), table of the human driver model (page 216)."""
    gap_error: float = 0.1
    """V_s, standard deviation of the logarithm of the estimated gap: the same table."""
    approach_error: float = 0.01
    """sigma_r [1/s], standard deviation of the error of the speed difference over the gap: the same table."""
    error_correlation: float = 20.0
    """Persistence of the errors of estimation [s]: the same table."""
    leaders: int = 5
    """Largest number of vehicles ahead to which it responds: the same table."""
    wandering: float = 0.375
    """A vehicle of the next lane is noticed when its centre is off its lane's centre by more than this, towards the
    driver [m]: UN Regulation 157, its model of a competent and careful human driver."""
    noticing_time: float = 0.4
    """... and for as long as this [s]: the same ("risk evaluation")."""
    jerk: float = 12.65
    """Fastest build-up of braking [m/s^3]: the same, 0.774 g within 0.6 s."""
    glances: bool = True
    """Whether it looks away from the road now and then, see `rare_envs.control.human_driver`."""

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if isinstance(value, int | float) and not value >= 0:
                raise ValueError(f"Expected {each.name} to be a number of at least 0, got {value!r}.")


def in_wandering_zone(state: State, road: Road, wandering: float) -> Tensor:
    """Return which vehicles are in the ego's lane, or off the next's centre towards it by `wandering` [m], (B, V)."""
    lane_y = road.centre_of(state.y[:, :1])
    return (state.y[:, 1:] - lane_y).abs() <= road.width - wandering


def look(state: State, noticed: Tensor) -> Percept:
    """Return what there is to see of V other vehicles, of which some are noticed (B, V)."""
    speed = state.speed[:, 1:] * torch.cos(state.heading[:, 1:] - state.heading[:, :1])
    return Percept(state.x[:, 1:] - state.x[:, :1], speed, noticed)


def inverse_tau(percept: Percept, speed: Tensor) -> Tensor:
    """Return how fast the most urgent leader comes closer, as a share of its gap [1/s], (B,), 0 without: 1 / TTC."""
    gap = (percept.distance - VEHICLE_LENGTH).clamp(min=NEAR_ZERO)
    ahead = percept.noticed & (percept.distance >= 0.0)
    closing = torch.where(ahead, speed[:, None] - percept.speed, 0.0)
    return (closing / gap).amax(dim=1).clamp(min=0.0)


def step_errors(errors: Tensor, fresh: Tensor, dt: float, correlation: float) -> Tensor:
    """Return errors after dt [s]: exact Ornstein-Uhlenbeck processes of variance 1, from fresh normal draws."""
    kept = math.exp(-dt / correlation) if correlation else 0.0
    return kept * errors + math.sqrt(1.0 - kept * kept) * fresh


def estimate_leads(percept: Percept, speed: Tensor, errors: Tensor, model: HumanDriverModel) -> Lead:
    """Return gaps and speed differences to V leaders as a driver estimates them, (B, V), with gap inf for others.

    s_est = s exp(V_s w_s) and dv_est = dv + s sigma_r w_v with errors w_s and w_v (B, 2); bodies in between are no gap.
    """
    ahead = percept.noticed & (percept.distance >= 0.0)
    way = torch.where(ahead, percept.distance, torch.inf)
    between = (way[:, None, :] < way[:, :, None]).sum(dim=2)
    led = ahead & (between < max(model.leaders, 1))
    gap = torch.where(led, percept.distance - VEHICLE_LENGTH * (between + 1), 0.0)
    error = gap.abs() * model.approach_error * errors[:, 1:]
    estimated = gap * torch.exp(model.gap_error * errors[:, :1])
    closing = torch.where(led, speed[:, None] - percept.speed + error, 0.0)
    return Lead(torch.where(led, estimated, torch.inf), closing)


def anticipate(lead: Lead, speed: Tensor, acceleration: Tensor, delay: float) -> tuple[Lead, Tensor]:
    """Return leads (B, V) and own speed (B,) after a delay [s] in which other speeds and the own acceleration stay."""
    expected = lead._replace(gap=lead.gap - delay * lead.closing_speed)
    return expected, (speed + delay * acceleration).clamp(min=0.0)


def respond(lead: Lead, speed: Tensor, model: HumanDriverModel) -> Tensor:
    """Return the acceleration that a driver chooses behind V leads (B, V) as it expects them [m/s^2], (B,).

    (s*/s_j)^2 of n leaders are weighted by 1 / sum_j j^-2: a queue in equilibrium keeps the gaps of the IDM.
    """
    ratio = speed / model.idm.desired_speed
    each = model.idm.interaction(speed[:, None], ratio[:, None], lead)
    seen = torch.isfinite(lead.gap).sum(dim=1)
    weights = [1.0 / sum(j**-2 for j in range(1, n + 1)) if n else 1.0 for n in range(lead.gap.shape[1] + 1)]
    weight = constant(tuple(weights), speed)[seen]
    return model.idm.combine(ratio, weight * each.sum(dim=1))
