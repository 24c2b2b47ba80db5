"""Realism score after the Waymo Open Sim Agents Challenge: how likely is the recorded future under many rollouts?

Of every feature of motion (`training.imitation.evaluation.sim_agents_features`) and every agent, a histogram over the
steps of all rollouts is smoothed by a pseudocount. The likelihood of a feature is the exponential of the mean, over
agents and valid steps, of the logarithm of the probability of the recorded value's bin. Collision and leaving the road
are one event per agent and rollout. The score is the weighted mean of the nine likelihoods: 0 to 1, higher is better.

It is no probability: even a copy of the record scores less than 1, because the bins pool the steps of 8 s.

References:
    Montali et al., "The Waymo Open Sim Agents Challenge", 2023 (arXiv 2305.12032), and the settings released with the
    evaluation of 2023 and 2024 (github.com/waymo-research/waymo-open-dataset, `sim_agents_metrics`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from training.imitation.evaluation.sim_agents_features import (
    FEATURE_NAMES,
    INTERACTIVE,
    KINEMATIC,
    MAP_BASED,
    motion_features,
)

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
"""The challenge's settings of 2024; those of 2025 move half of the weight of the road edge to traffic lights."""
WOSAC_2023: Settings = MappingProxyType(
    {
        "linear_speed": FeatureSetting(0.0, 35.0, 10, 0.09),
        "linear_acceleration": FeatureSetting(-15.0, 15.0, 10, 0.09),
        "angular_speed": FeatureSetting(-31.5, 31.5, 10, 0.09),
        "angular_acceleration": FeatureSetting(-31.5, 31.5, 10, 0.09),
        "distance_to_nearest_object": FeatureSetting(-5.0, 40.0, 10, 0.09),
        "collision_indication": _event(0.18),
        "time_to_collision": FeatureSetting(0.0, 5.0, 10, 0.09),
        "distance_to_road_edge": FeatureSetting(-20.0, 40.0, 10, 0.09),
        "offroad_indication": _event(0.18),
    }
)
"""Those of 2023, the paper's; the weights sum to 0.99, so scores are divided by that. Their even number of bins has an
edge at 0, where accelerations and yaw rates are."""
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
    """Score of rollouts of one scene.

    Example:
        >>> SimAgentsScore(0.7, {"kinematic": 0.4}, {"linear_speed": 0.5}, 1.2).meta
        0.7
    """

    meta: float
    """The realism score: weighted mean of the likelihoods."""
    buckets: Mapping[str, float]
    """Weighted means of each group of features in `BUCKETS`."""
    likelihoods: Mapping[str, float]
    """Likelihood of each feature."""
    min_ade: float
    """Least over the rollouts of the mean distance from the recorded position [m]."""


def score_rollouts(
    rollouts: Tensor,
    recorded: Tensor,
    valid: Tensor,
    sizes: Tensor,
    edges: tuple[float, float],
    scored: Tensor | None = None,
    settings: Mapping[str, Settings] | None = None,
    history: int = 1,
    copies: int = 1,
) -> dict[str, SimAgentsScore]:
    """Return the scores of rollouts of one scene, by each of some settings.

    Unlike in the challenge, a step of a rollout counts only where the agent is recorded then: recorded vehicles leave
    the window early, and would otherwise be compared with what is simulated beyond it.

    Args:
        rollouts: Poses (x [m], y [m], heading [rad]), shape (R, n_agents, T, 3).
        recorded: The recorded future, shape (n_agents, T, 3); any finite values where it is not valid.
        valid: Where it is, boolean, shape (n_agents, T).
        sizes: Lengths and widths [m], shape (n_agents, 2).
        edges: y of the left and the right edge of the straight road [m].
        scored: Agents that are scored, boolean, shape (n_agents,); None for all. The others are only seen.
        settings: Settings by name; None for `WOSAC_2024` as "wosac_2024".
        history: Number of first steps that are the recorded past: differences use them, but they are not scored.
        copies: How often each rollout counts: R = 1 and 32 copies are 32 rollouts of a driver without noise.

    Raises:
        ValueError: If shapes do not fit together, or no scored agent is valid for five steps.

    Example:
        >>> step = torch.arange(31.0)
        >>> record = torch.stack((1.5 * step, 0 * step, 0 * step), -1)[None]  # alone, at 15 m/s
        >>> valid, sizes = torch.ones(1, 31, dtype=bool), torch.tensor([[4.5, 2.0]])
        >>> found = score_rollouts(record[None], record, valid, sizes, (-2.0, 2.0), copies=32)["wosac_2024"]
        >>> round(found.meta, 3)
        0.999
    """
    if rollouts.ndim != 4 or rollouts.shape[1:] != recorded.shape:
        raise ValueError(
            f"Expected rollouts of shape (R, n_agents, T, 3) beside a record of shape {tuple(recorded.shape)}, got "
            f"{tuple(rollouts.shape)}."
        )
    chosen = torch.ones(len(valid), dtype=torch.bool) if scored is None else scored
    future = valid[chosen].clone()
    future[:, :history] = False
    simulated = motion_features(rollouts, valid, sizes, edges, chosen)
    real = motion_features(recorded, valid, sizes, edges, chosen)
    error = torch.hypot(*(rollouts - recorded)[:, chosen, :, :2].movedim(-1, 0))
    min_ade = float((error * future).sum(dim=(1, 2)).min() / future.sum())
    named = {"wosac_2024": WOSAC_2024} if settings is None else settings
    return {name: score_features(simulated, real, future, one, min_ade, copies) for name, one in named.items()}


def score_features(
    simulated: Mapping[str, Tensor],
    recorded: Mapping[str, Tensor],
    valid: Tensor,
    settings: Settings,
    min_ade: float,
    copies: int = 1,
) -> SimAgentsScore:
    """Return the score of features that `motion_features` gave.

    Args:
        simulated: Of the rollouts, shape (R, n, T) each.
        recorded: Of the record, shape (n, T) each.
        valid: Steps that count, boolean, shape (n, T).
        settings: Histograms and weights.
        min_ade: Kept in the score [m].
        copies: As in `score_rollouts`.

    Raises:
        ValueError: If a recorded feature exists at no valid step.
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
    """Return the likelihood of a recorded feature, 0 to 1.

    Args:
        name: Of the feature; those in `EVENTS` count by whether they occur at any valid step.
        simulated: Shape (R, n, T), NaN where the feature does not exist.
        recorded: Shape (n, T), likewise.
        valid: Which steps count, boolean, shape (n, T).
        setting: Histogram.
        copies: How often each rollout counts.

    Raises:
        ValueError: If the recorded feature exists at no valid step.
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
    """Return the logarithm of the probability of the recorded values' bins, of each agent's histogram.

    Args:
        simulated: Shape (R, n, T); its values at valid steps, if finite, make the histogram of each of the n agents.
        recorded: Shape (n, T).
        valid: Boolean, shape (n, T); elsewhere the result means nothing.
        setting: Histogram.
        copies: How often each simulated value counts.

    Returns:
        Shape (n, T), double precision.

    Example:
        >>> halves = FeatureSetting(0.0, 2.0, 2, 1.0, pseudocount=1.0)
        >>> simulated = torch.tensor([[[0.5, 0.5]], [[0.5, 1.5]]])  # three in the first bin, one in the second
        >>> once = torch.ones(1, 2, dtype=bool)
        >>> histogram_log_likelihood(simulated, torch.tensor([[0.1, 1.9]]), once, halves).exp()  # 4 / 6 and 2 / 6
        tensor([[0.6667, 0.3333]], dtype=torch.float64)
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
