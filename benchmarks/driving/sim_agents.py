"""Realism score after the Waymo Open Sim Agents Challenge: how likely is the recorded future under many rollouts?

Features of motion follow from poses and sizes, as in the challenge: speeds and accelerations are central differences of
positions and headings, distances are those of rectangles. The road is straight, between two edges. Of every feature and
every agent, a histogram over the steps of all rollouts is smoothed by a pseudocount. The likelihood of a feature is the
exponential of the mean, over agents and valid steps, of the logarithm of the probability of the recorded value's bin.
Collision and leaving the road are one event per agent and rollout. The score is the weighted mean of the nine
likelihoods: 0 to 1, higher is better. It is no probability: even a copy of the record scores less than 1, because the
bins pool the steps of 8 s.

References:
    Montali et al., "The Waymo Open Sim Agents Challenge", 2023 (arXiv 2305.12032); the definitions that the text leaves
    open, and the settings, are those of the released evaluation of 2024
    (github.com/waymo-research/waymo-open-dataset, `sim_agents_metrics`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from training.data.table import DT

AT_ONCE = 2
"""Rollouts whose pairs of agents are looked at together."""
MAX_TIME_TO_COLLISION = 5.0
"""[s]; longer ones, and those of vehicles that follow nobody, are this."""
FOLLOWING_TURN = math.radians(75.0)
"""Largest difference of headings [rad] of a vehicle and the one that it follows."""
FOLLOWING_TURN_GRAZING = math.radians(10.0)
"""The same where they overlap by less than `GRAZING` across."""
FAR = 1e4
"""Distance to the nearest object of an agent that is alone [m]."""
GRAZING = 0.5
"""[m]."""
KINEMATIC = ("linear_speed", "linear_acceleration", "angular_speed", "angular_acceleration")
INTERACTIVE = ("distance_to_nearest_object", "collision_indication", "time_to_collision")
MAP_BASED = ("distance_to_road_edge", "offroad_indication")
FEATURE_NAMES = (*KINEMATIC, *INTERACTIVE, *MAP_BASED)


def motion_features(
    states: Tensor, valid: Tensor, sizes: Tensor, edges: tuple[float, float], scored: Tensor | None = None
) -> dict[str, Tensor]:
    """Return the features of every agent at every step.

    Of n agents there are poses (..., n, T, 3): x along the road [m], y across it and positive to the right [m], heading
    [rad], where leading axes may be rollouts; `valid` (n, T), where an agent is recorded, as nobody sees it elsewhere;
    lengths and widths (n, 2) [m]; y of the left and the right edge of the road [m]. Agents that are `scored`, boolean
    (n,), all if None, get `FEATURE_NAMES` with values (..., scored agents, T) in SI units, NaN where a feature does not
    exist; those of collision and off-road are 0 or 1 by step.
    """
    if states.ndim > 3 and len(states) > AT_ONCE:  # small parts stay in the processor's cache
        parts = [motion_features(part, valid, sizes, edges, scored) for part in torch.split(states, AT_ONCE)]
        return {name: torch.cat([part[name] for part in parts]) for name in FEATURE_NAMES}
    chosen = torch.ones(len(valid), dtype=torch.bool) if scored is None else scored
    own = chosen.nonzero()[:, 0]
    speed, *changes = kinematic_features(states)
    once = _both(valid) & valid
    distance, time = _interactive(states, speed, (valid, once), sizes, own)
    across = _outermost(states[..., own, :, :], sizes[own], edges)
    there = valid[own]
    values = [*(change[..., own, :] for change in (speed, *changes)), distance, (distance < 0).to(distance), time]
    values += [across, (across > 0).to(across)]
    twice = _both(once) & once
    kept = [once[own], twice[own], once[own], twice[own], there, there, once[own], there, there]
    return {
        name: torch.where(mask, value, torch.nan) for name, value, mask in zip(FEATURE_NAMES, values, kept, strict=True)
    }


def kinematic_features(states: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return linear speed and acceleration, angular speed and acceleration of poses: (..., T, 3) -> (..., T) each.

    Central differences; NaN at the first and last step, of accelerations at the first and last two.
    """
    change = central_difference(states.movedim(-1, 0))
    speed, turn = torch.hypot(change[0], change[1]), _wrap(2.0 * change[2] * DT) / (2.0 * DT)
    return speed, central_difference(speed), turn, central_difference(turn)


def central_difference(values: Tensor) -> Tensor:
    """Return the derivative along the last axis [1/s], (x[t + 1] - x[t - 1]) / 2 dt, NaN at both ends."""
    inner = (values[..., 2:] - values[..., :-2]) / (2.0 * DT)
    return torch.nn.functional.pad(inner, (1, 1), value=torch.nan)


def _wrap(angle: Tensor) -> Tensor:
    return torch.remainder(angle + torch.pi, 2 * torch.pi) - torch.pi


def _both(valid: Tensor) -> Tensor:
    """Return whether a central difference is of two valid steps."""
    return torch.nn.functional.pad(valid[..., 2:] & valid[..., :-2], (1, 1), value=False)


def _interactive(
    states: Tensor, speed: Tensor, valid: tuple[Tensor, Tensor], sizes: Tensor, own: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the distance to the nearest other agent and the time to collision, (..., m, T) each.

    `valid` says where poses and where speeds are known; an agent without a speed is not one to follow.
    """
    x, y, heading = states.movedim(-1, 0)
    agents = len(sizes)

    def pair(field: Tensor) -> tuple[Tensor, Tensor]:
        return field[..., own, None, :], field[..., None, :, :]

    (own_x, x), (own_y, y), (own_heading, heading) = pair(x), pair(y), pair(heading)
    size, other_size = ((part[:, None, None] for part in sizes[own].T), (part[None, :, None] for part in sizes.T))
    (length, width), (other_length, other_width) = size, other_size
    turn = heading - own_heading
    cos, sin = torch.cos(own_heading), torch.sin(own_heading)
    dx, dy = x - own_x, y - own_y
    along, across = dx * cos + dy * sin, dy * cos - dx * sin
    others = ~torch.eye(agents, dtype=torch.bool)[own]
    seen, known = (others[..., None] & each[None] for each in valid)
    distance = box_distance_of_sizes(along, across, turn, (length, width), (other_length, other_width))
    nearest = torch.where(seen, distance, FAR).amin(dim=-2)
    cos, sin = torch.cos(turn).abs(), torch.sin(turn).abs()
    ahead = along - 0.5 * length - 0.5 * (other_length * cos + other_width * sin)
    aside = across.abs() - 0.5 * width - 0.5 * (other_length * sin + other_width * cos)
    follows = (ahead > 0) & (aside < 0) & (turn.abs() <= FOLLOWING_TURN) & known
    follows = follows & ((aside < -GRAZING) | (turn.abs() <= FOLLOWING_TURN_GRAZING))
    lead = torch.where(follows, ahead, torch.inf).min(dim=-2)
    lead_speed = speed[..., None, :, :].expand_as(ahead).gather(-2, lead.indices[..., None, :])[..., 0, :]
    closing = speed[..., own, :] - lead_speed
    time = torch.where(closing > 0, lead.values / closing, torch.inf).clamp(max=MAX_TIME_TO_COLLISION)
    return nearest, time


def box_distance_of_sizes(
    along: Tensor,
    across: Tensor,
    turn: Tensor,
    size: tuple[Tensor, Tensor],
    other_size: tuple[Tensor, Tensor],
) -> Tensor:
    """Return the distance between rectangles [m], the negative depth of their overlap if they do.

    The centre of the other is so far along and across the first [m], its heading is turned [rad]; sizes are lengths and
    widths [m].
    """
    cos, sin = torch.cos(turn), torch.sin(turn)
    other_along, other_across = along * cos + across * sin, across * cos - along * sin
    half, other_half = (tuple(0.5 * part for part in each) for each in (size, other_size))
    steep, flat = cos.abs(), sin.abs()
    gaps = (
        along.abs() - half[0] - other_half[0] * steep - other_half[1] * flat,
        across.abs() - half[1] - other_half[0] * flat - other_half[1] * steep,
        other_along.abs() - other_half[0] - half[0] * steep - half[1] * flat,
        other_across.abs() - other_half[1] - half[0] * flat - half[1] * steep,
    )
    depth = torch.maximum(torch.maximum(gaps[0], gaps[1]), torch.maximum(gaps[2], gaps[3]))
    corners = _nearest_corner(along, across, cos, sin, half, other_half)
    own_corners = _nearest_corner(-other_along, -other_across, cos, -sin, other_half, half)
    return torch.where(depth < 0, depth, torch.minimum(corners, own_corners).sqrt())


def _nearest_corner(
    along: Tensor, across: Tensor, cos: Tensor, sin: Tensor, half: tuple[Tensor, ...], other_half: tuple[Tensor, ...]
) -> Tensor:
    """Return the least squared distance of a corner of the other rectangle from the first [m^2]."""
    least = None
    for ahead, right in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        u, v = ahead * other_half[0], right * other_half[1]
        out = (along + u * cos - v * sin).abs() - half[0]
        aside = (across + u * sin + v * cos).abs() - half[1]
        square = out.clamp(min=0.0).square() + aside.clamp(min=0.0).square()
        least = square if least is None else torch.minimum(least, square)
    assert least is not None
    return least


def _outermost(states: Tensor, sizes: Tensor, edges: tuple[float, float]) -> Tensor:
    """Return how far the outermost corner is beyond the nearer edge of the road [m], negative on the road."""
    y, heading = states[..., 1], states[..., 2]
    length, width = sizes[:, :1], sizes[:, 1:]
    reach = 0.5 * (length * torch.sin(heading).abs() + width * torch.cos(heading).abs())
    return torch.maximum(edges[0] - (y - reach), (y + reach) - edges[1])


SCENE_ROLLOUTS = 32
"""Rollouts of the challenge."""
BUCKETS = MappingProxyType({"kinematic": KINEMATIC, "interactive": INTERACTIVE, "map_based": MAP_BASED})
"""Groups of features that the challenge's table has."""
EVENTS = ("collision_indication", "offroad_indication")
"""Features of which only whether they ever occur counts."""


class FeatureSetting(NamedTuple):
    """Histogram of a feature, and its weight in the score."""

    low: float
    """Lowest edge; values below count in the first bin."""
    high: float
    """Highest edge; values above count in the last bin."""
    bins: int
    weight: float
    pseudocount: float = 0.1
    """Added to the count of every bin."""


Settings = Mapping[str, FeatureSetting]


def _event(weight: float) -> FeatureSetting:
    return FeatureSetting(-0.5, 1.5, 2, weight, 0.001)


WOSAC_2024: Settings = MappingProxyType(
    {
        "linear_speed": FeatureSetting(0.0, 25.0, 10, 0.05),
        "linear_acceleration": FeatureSetting(-12.0, 12.0, 11, 0.05),
        "angular_speed": FeatureSetting(-0.628, 0.628, 11, 0.05),
        "angular_acceleration": FeatureSetting(-3.14, 3.14, 11, 0.05),
        "distance_to_nearest_object": FeatureSetting(-5.0, 40.0, 10, 0.1),
        "collision_indication": _event(0.25),
        "time_to_collision": FeatureSetting(0.0, 5.0, 10, 0.1),
        "distance_to_road_edge": FeatureSetting(-20.0, 40.0, 10, 0.1),
        "offroad_indication": _event(0.25),
    }
)
"""The challenge's settings."""
MOTORWAY: Settings = MappingProxyType(
    {
        **WOSAC_2024,
        "linear_speed": FeatureSetting(0.0, 30.0, 30, 0.05),
        "linear_acceleration": FeatureSetting(-4.2, 4.2, 21, 0.05),
        "angular_speed": FeatureSetting(-0.105, 0.105, 21, 0.05),
        "angular_acceleration": FeatureSetting(-0.42, 0.42, 21, 0.05),
        "distance_to_nearest_object": FeatureSetting(-2.0, 20.0, 22, 0.1),
        "distance_to_road_edge": FeatureSetting(-10.0, 2.0, 24, 0.1),
    }
)
"""Ours: the weights of 2024 with bins for smoothed motorway traffic, where nearly all recorded yaw rates lie in one
published bin."""


@dataclass(frozen=True)
class SimAgentsScore:
    """Score of rollouts of one scene."""

    meta: float
    """The realism score: weighted mean of the likelihoods."""
    buckets: Mapping[str, float]
    """Weighted means of each group of features in `BUCKETS`."""
    likelihoods: Mapping[str, float]
    """Likelihood of each feature."""
    min_ade: float
    """Least over the rollouts of the mean distance from the recorded position [m]."""


def score_features(
    simulated: Mapping[str, Tensor],
    recorded: Mapping[str, Tensor],
    valid: Tensor,
    settings: Settings,
    min_ade: float,
    copies: int = 1,
) -> SimAgentsScore:
    """Return the score of features that `motion_features` gave: of rollouts (R, n, T), of the record (n, T).

    `valid` (n, T) says which steps count; `min_ade` [m] is kept in the score; each rollout counts so many times. A
    ValueError says that a recorded feature exists at no valid step.
    """
    likelihoods = {
        name: feature_likelihood(name, simulated[name], recorded[name], valid, settings[name], copies)
        for name in FEATURE_NAMES
    }
    buckets = {bucket: _weighted(likelihoods, settings, members) for bucket, members in BUCKETS.items()}
    return SimAgentsScore(_weighted(likelihoods, settings, FEATURE_NAMES), buckets, likelihoods, min_ade)


def _weighted(likelihoods: Mapping[str, float], settings: Settings, features: tuple[str, ...]) -> float:
    total = sum(settings[feature].weight for feature in features)
    return sum(settings[feature].weight * likelihoods[feature] for feature in features) / total


def feature_likelihood(
    name: str, simulated: Tensor, recorded: Tensor, valid: Tensor, setting: FeatureSetting, copies: int = 1
) -> float:
    """Return the likelihood of a recorded feature, 0 to 1; shapes and errors as in `score_features`.

    Features in `EVENTS` count by whether they occur at any valid step; elsewhere NaN says that there is no feature.
    """
    valid = valid & torch.isfinite(recorded)
    if not bool(valid.any()):
        raise ValueError(f"Expected a recorded {name} at some valid step, got none; take longer records.")
    if name in EVENTS:
        simulated = ((simulated > 0) & valid).any(dim=-1, keepdim=True).to(simulated)
        recorded = ((recorded > 0) & valid).any(dim=-1, keepdim=True).to(recorded)
        valid = valid.any(dim=-1, keepdim=True)
    log_likelihood = histogram_log_likelihood(simulated, recorded, valid, setting, copies)
    return float(log_likelihood[valid].mean().exp())


def histogram_log_likelihood(
    simulated: Tensor, recorded: Tensor, valid: Tensor, setting: FeatureSetting, copies: int = 1
) -> Tensor:
    """Return the logarithm of the probability of the recorded values' bins, of each agent's histogram, shape (n, T).

    Simulated values (R, n, T) at valid steps (n, T), if finite, make the histogram of each of the n agents.
    """
    counted = (valid & torch.isfinite(simulated)).double()
    place = _bin_of(simulated, setting).movedim(0, 1).flatten(1)  # (n, R T)
    counts = torch.zeros(len(recorded), setting.bins, dtype=torch.float64)
    counts.scatter_add_(1, place, counted.movedim(0, 1).flatten(1))
    counts = copies * counts + setting.pseudocount
    logarithms = (counts / counts.sum(dim=1, keepdim=True)).log()
    return logarithms.gather(1, _bin_of(recorded, setting))


def _bin_of(values: Tensor, setting: FeatureSetting) -> Tensor:
    share = (torch.nan_to_num(values, nan=setting.low).double() - setting.low) / (setting.high - setting.low)
    return (share * setting.bins).floor().clamp(0, setting.bins - 1).long()
