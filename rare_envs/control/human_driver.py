"""The human driver model of Treiber, Kesting and Helbing, with published limits of perception and braking; and glances.

Reaction time, errors of estimation and anticipation around the improved IDM with the constant-acceleration heuristic,
when eyes leave the road and what brings them back, and steering away from who comes in. Everything here is a formula of
what the driver has seen; `rare_envs.egos.human` adds the memory that makes an ego of it.

Glances away from the road: 4,604 of 1,791 baseline epochs of SHRP 2, coded from video in steps of 0.1 s, the longest
6.7 s. Their table is not published. It is found from the probabilities of the overshot of Imberg et al. (2022,
github.com/imbhe/Active-Sampling, `Application/Data`): they put a glance of duration d over a moment so that it goes on
for 0, 0.1, ..., d s with equal probabilities, so the number of glances of duration d is proportional to (d / 0.1 + 1)
times the difference of neighbouring probabilities. All counts above 2 s come out whole, 4,608 in all.

References:
    Treiber, Kesting and Helbing, "Delays, inaccuracies and anticipation in microscopic traffic models", Physica A 360,
    2006; Treiber and Kesting, "Traffic Flow Dynamics", Springer, 2013, chapter 12; Kesting, Treiber and Helbing, 2010
    (see `rare_envs.control.idm`); Bargman et al., 2024; Pekkanen et al., "Task-difficulty homeostasis in car following
    models", PLoS ONE e0169704, 2017.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.control.idm import COOLNESS, IDM, MAX_HEADING_COMMAND, check_numbers, improved_acceleration
from rare_envs.devices import constant
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import MAX_SLIP_SINE, NEAR_ZERO, STANDARD_GRAVITY, VEHICLE_LENGTH, State

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


_RANGES: Final = {
    "from 0 to 1": ("coolness", "evasive_share"),
    "from 0 to 180 degrees": ("glance_eccentricity",),
    "of at least 0": ("brake_light", "glance_looming"),
    "of at least 0, finite": (
        "reaction_time",
        "noticing_time",
        "gap_error",
        "approach_error",
        "wandering",
        "glance_ttc",
        "evasive_distance",
        "evasive_reach",
        "evasive_clearance",
    ),
    "above 0": ("jerk",),
    "above 0, finite": ("error_correlation", "evasive_acceleration"),
}


LONGEST_REACTION = 0.6
"""Longest reaction time [s] at which this model of braking was held against people."""


@dataclass(frozen=True)
class HumanDriverModel:
    """Parameters of an attentive human driver, each with its source; none is fitted, and what is assumed says so.

    Values of the book and of Regulation 157 are as quoted or implemented in public; neither text was consulted.

    Raises:
        ValueError: A parameter is out of its range: shares and weights are from 0 to 1, angles from 0 to 180 degrees,
            all others finite and at least 0. `brake_light`, `glance_looming` and `jerk` may be infinite: no braking is
            seen, whatever closes lets a glance begin, brakes build up at once. `jerk`, `error_correlation` and
            `evasive_acceleration` are above 0.

    Warns:
        UserWarning: The reaction time is above 0.6 s.
    """

    idm: IDM = ATTENTIVE_IDM
    """How the driver wants to drive: parameters of `rare_envs.control.idm.improved_acceleration`."""
    coolness: float = COOLNESS
    """Weight of the constant-acceleration heuristic while no braking of the lead is seen: Kesting, Treiber and Helbing
    (2010)."""
    brake_light: float = 0.5
    """Deceleration of the lead that is seen as braking [m/s^2], assumed. Behind it the driver follows the improved IDM
    alone, which is assumed too: the heuristic aims at stopping with no gap left."""
    reaction_time: float = 0.6
    """T' [s]: Treiber and Kesting (2013), table of the human driver model (page 216). Leave it: with 1 s and this
    model of braking drivers touch braking leads 100 to 300 times as often (measured). People who react late brake
    otherwise, by what they see then; a longer time needs another model of braking."""
    gap_error: float = 0.1
    """V_s, standard deviation of the logarithm of the estimated gap: the same table."""
    approach_error: float = 0.01
    """sigma_r [1/s], standard deviation of the error of the speed difference over the gap: the same table."""
    error_correlation: float = 20.0
    """Persistence of the errors of estimation [s]: the same table."""
    wandering: float = 0.375
    """A vehicle of the next lane is noticed when its centre is off its lane's centre, or off where it began if that was
    further away, by more than this, towards the driver [m]: UN Regulation 157, its model of a competent and careful
    human driver."""
    noticing_time: float = 0.4
    """... and for as long as this [s]: the same ("risk evaluation")."""
    notice_indicator: bool = True
    """Whether a vehicle that signals is noticed at once, from the start on if it signals then: assumed."""
    jerk: float = 12.65
    """Fastest build-up of braking [m/s^3]: Regulation 157, 0.774 g within 0.6 s."""
    glances: bool = True
    """Whether it looks away from the road now and then, see `rare_envs.control.human_driver`."""
    glance_ttc: float = 5.0
    """No glance is begun at a shorter time to collision [s]: an assumption of the crash causation model of Bargman et
    al. (2024), after Victor et al. ("Analysis of naturalistic driving study data: safer glances", SHRP 2, 2015)."""
    glance_looming: float = 0.003
    """No glance is begun while the lead can be seen to come nearer, at an expansion rate above this [rad/s]: Hoffmann
    and Mortimer ("Drivers' estimates of time to collision", Accident Analysis and Prevention 28, 1996). Glances do
    begin at closing speeds near zero ("Driver eye glance behavior during car following: timing matters", 2015)."""
    glance_eccentricity: float = 30.0
    """Angle between a glance and the road [deg], by which `seen_expansion_rate` says when looming breaks it off. Beyond
    90 degrees none is broken off. In-car displays are at 20 to 40 degrees, this is the middle of that, assumed for
    every glance. It hardly matters: without the headway rule 2 to 3 of 100,000 stops of the lead end in contact at 0,
    30 and 90 degrees alike, and 1,300 do if no glance is broken off."""
    headway_rule: bool = True
    """Whether a glance is no longer than the headway (gap over own speed) at its beginning less the reaction time.
    That self-paced occlusion grows one to one with headway is Pekkanen et al.'s (2017, in a simulator), that it is
    shorter by the reaction time is assumed. "human:no-headway-rule" is without."""
    evasive_share: float = 0.48
    """Share of drivers who steer away from whom comes in beside them: 66 of 137 cut-in near-crashes and crashes of the
    100-Car study (its public event table). 0 switches it off."""
    evasive_distance: float = 1.0
    """How far they steer [m], less where their body would leave the lane: assumed, between the 2 ft of drivers over 25
    and the 6 ft of younger ones in SHRP 2 (SAE 2015-01-1417, its abstract). It is steered open loop, as people do:
    Markkula, Benderius and Wahde ("Comparing and validating models of driver steering behaviour in collision avoidance
    and vehicle stabilisation", Vehicle System Dynamics 52, 2014)."""
    evasive_acceleration: float = 0.4 * STANDARD_GRAVITY
    """Acceleration across, in this manoeuvre [m/s^2]: assumed, that from which on the 100-Car study calls steering
    rapid, 0.4 g (VTTI, "Researcher dictionary for video reduction data" 1.3, 2012, variable 5)."""
    evasive_reach: float = 1.0
    """Bodies that come in beside the own one or within this way ahead or behind [m] are steered away from: assumed."""
    evasive_clearance: float = 0.8
    """... and those with less than this between the sides, were the own one in the middle of its lane [m]: assumed."""

    def __post_init__(self) -> None:
        check_numbers(self, "human driver", _RANGES)
        if self.reaction_time > LONGEST_REACTION:
            warnings.warn(
                f"reaction_time={self.reaction_time:g} s: above {LONGEST_REACTION} s this model of braking is wrong. "
                "At 1 s its drivers touch braking leads a hundred times as often as people do, or more; results with "
                "it say nothing about people who react late.",
                stacklevel=3,
            )


SEEN_WIDTH = 1.8
"""Width of a car as it is seen from behind [m], assumed."""


NOBODY = 1e9
"""Distance of nobody [m]: finite, so that there are gradients."""


class Ahead(NamedTuple):
    """The nearest noticed vehicle ahead of B drivers, shape (B,) each; only the gap has a meaning for nobody."""

    gap: Tensor
    """Bumper to bumper [m], negative side by side, about `NOBODY` for nobody."""
    speed: Tensor
    """Of the vehicle along the driver's heading [m/s]."""
    acceleration: Tensor
    """Of the vehicle [m/s^2]."""


def find_ahead(state: State, noticed: Tensor, before: Tensor, dt: float) -> Ahead:
    """Return the nearest ahead of the V other vehicles that are noticed, with their speeds a tick before; (B, V)."""
    ahead = state.x[:, 1:] - state.x[:, :1]
    distance, nearest = torch.where(noticed & (ahead >= 0.0), ahead, NOBODY).min(dim=1)
    which = nearest[:, None]
    speed, heading, former = (
        each.gather(1, which)[:, 0] for each in (state.speed[:, 1:], state.heading[:, 1:], before)
    )
    along = speed * torch.cos(heading - state.heading[:, 0])
    return Ahead(distance - VEHICLE_LENGTH, along, (speed - former) / dt)


def expansion_rate(gap: Tensor, closing: Tensor) -> Tensor:
    """Return how fast the angle grows under which a lead is seen [rad/s], W dv / (s^2 + W^2 / 4), (B,).

    Example:
        >>> expansion_rate(torch.tensor([20.0, torch.inf]), torch.tensor([1.0, 1.0]))
        tensor([0.0045, 0.0000])
    """
    return closing * SEEN_WIDTH / (gap.clamp_min(0.0).square() + SEEN_WIDTH**2 / 4)


LAMBLE_ECCENTRICITIES: Final = (0.0, 17.0, 24.0, 44.0, 63.0, 90.0)
"""[deg]; the columns of the next two."""
LAMBLE_AT_20_M: Final = (0.00380, 0.00617, 0.00646, 0.00739, 0.00858, 0.01483)
"""Expansion rate [rad/s] of a lead 20 m ahead at which drivers who looked at a display noticed that it came nearer:
Lamble, Laakso and Summala ("Detection thresholds in car following situations and peripheral vision", Ergonomics 42,
1999, figure 4, as digitised in github.com/gmarkkula/HFES2014ModelsAndFigs). It agrees with their abstract, by which
6 to 8 s were left until contact at 0 degrees and 4 s at 90, behind a lead that slowed down by 0.7 m/s^2. They expected
it to: drivers who do not may see less."""
LAMBLE_AT_40_M: Final = (0.00211, 0.00452, 0.00498, 0.00710, 0.00731, 0.01302)
"""... 40 m ahead."""
EDGE_OF_SIGHT = 90.0
"""Eccentricity beyond which nothing is seen [deg], the largest of the table."""


def seen_expansion_rate(gap: Tensor, eccentricity: float) -> Tensor:
    """Return from which expansion rate [rad/s] on a lead is seen to come nearer, by its gap [m], (B,).

    Interpolated in eccentricity [deg] and in the logarithm of the gap; nearer than 20 m as at 20 m, beyond 40 m as at
    40 m, beyond the edge of sight inf.

    Example:
        >>> seen_expansion_rate(torch.tensor([10.0, 20.0, 28.28, 40.0]), 24.0)
        tensor([0.0065, 0.0065, 0.0057, 0.0050])
    """
    if eccentricity > EDGE_OF_SIGHT:
        return torch.full_like(gap, torch.inf)
    near, far = (float(np.interp(eccentricity, LAMBLE_ECCENTRICITIES, at)) for at in (LAMBLE_AT_20_M, LAMBLE_AT_40_M))
    return torch.log2(gap.clamp(20.0, 40.0)) * (far - near) + (near - (far - near) * math.log2(20.0))


def step_errors(errors: Tensor, fresh: Tensor, dt: float, correlation: float) -> Tensor:
    """Return errors after dt [s]: exact Ornstein-Uhlenbeck processes of variance 1, from fresh normal draws."""
    kept = math.exp(-dt / correlation)
    return kept * errors + math.sqrt(1.0 - kept * kept) * fresh


FARTHEST = 1e4
"""The error of a speed difference grows up to this gap [m]; of a gap to nobody there is none."""


def estimate(ahead: Ahead, speed: Tensor, errors: Tensor, model: HumanDriverModel) -> Lead:
    """Return gap and speed difference to a lead as drivers at speeds (B,) estimate them, with errors w_s, w_v (B, 2).

    s_est = s exp(V_s w_s) and dv_est = dv + s sigma_r w_v.
    """
    gap_error, approach_error = errors.unbind(1)
    error = ahead.gap.abs().clamp_max(FARTHEST) * (approach_error * model.approach_error)
    return Lead(ahead.gap * torch.exp(gap_error * model.gap_error), speed - ahead.speed + error)


def anticipate(lead: Lead, speed: Tensor, acceleration: Tensor, delay: float) -> tuple[Lead, Tensor]:
    """Return a lead and own speed (B,) after a delay [s] in which its speed and the own acceleration stay."""
    expected = lead._replace(gap=lead.gap - lead.closing_speed * delay)
    return expected, (speed + acceleration * delay).clamp(min=0.0)


def respond(lead: Lead, lead_acceleration: Tensor, speed: Tensor, model: HumanDriverModel) -> Tensor:
    """Return the acceleration that drivers at speeds (B,) choose behind leads as they expect them [m/s^2], (B,).

    The improved IDM with the heuristic, by the lead's acceleration where it brakes; behind seen braking without it.
    """
    coolness = (lead_acceleration >= -model.brake_light).to(speed.dtype) * model.coolness
    return improved_acceleration(model.idm, speed, lead, lead_acceleration.clamp_max(0.0), coolness=coolness)


def evasive_steps(distance: float, acceleration: float, dt: float) -> tuple[float, ...]:
    """Return the ways across in each tick [m], by which one moves so far and comes to rest: half the time each way.

    Example:
        >>> steps = evasive_steps(1.0, 4.0, 0.1)  # 1 s: faster by 4 m/s^2 for half of it, slower for the other
        >>> len(steps), round(sum(steps), 6), round(max(steps) / 0.1, 2)
        (10, 1.0, 1.8)
    """
    if not distance > 0.0 or not acceleration > 0.0:
        return ()
    lasting = 2.0 * math.sqrt(distance / acceleration)
    u = np.minimum(np.arange(math.ceil(lasting / dt - 1e-9) + 1) * dt / lasting, 1.0)
    place = np.where(u < 0.5, 2.0 * u**2, 1.0 - 2.0 * (1.0 - u) ** 2)
    return tuple((distance * np.diff(place)).tolist())


def steer_along(way: Tensor, heading: Tensor, speed: Tensor, dt: float) -> Tensor:
    """Return the steering angles [rad] by which the bicycle model moves so far across in a tick [m], (B,) each.

    Its course is heading + slip, so the slip is the course that is wanted less the heading. Slow vehicles, which would
    have to turn by more than 45 degrees, move as far as that takes them.
    """
    most = math.sin(MAX_HEADING_COMMAND)
    course = torch.asin((way / (speed * dt).clamp_min(NEAR_ZERO * dt)).clamp(-most, most))
    limit = math.asin(MAX_SLIP_SINE)
    return torch.atan(2.0 * torch.tan((course - heading).clamp(-limit, limit)))
