"""Accepted gaps fitted to recorded cut-ins: Gaussian coordinates times the probability that a driver accepts.

Closing speed and log gap, with the factor A of `rare_envs.distributions.acceptance`, have their five numbers and b by
maximum likelihood, the normaliser by quadrature. Given these two, A is a constant: the other columns are fitted by
ordinary regression on them. b is looked for from 0.1 to 20 m/s^2, where A is no factor any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy.optimize import minimize
from scipy.special import ndtr

from rare_envs.distributions.acceptance import AcceptedGaps, log_acceptance
from rare_envs.distributions.coordinates import Coordinates, Difference
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Parameter
from samplers.problem import FloatArray
from training.fit.filters import check_spread
from training.fit.mixture import COVARIANCE_FLOOR

LEAST_LIMIT, MOST_LIMIT = 0.1, 20.0
"""Range of b [m/s^2]."""
STARTS = (0.3, 1.0, 5.0)
"""Values of b from which the likelihood is climbed."""
PROFILE = (0.2, 0.5, 1.0, 2.0, 4.0)
"""Values of b whose likelihood is written down [m/s^2]."""
NODES, WEIGHTS = leggauss(80)
MOST_SHIFT, MOST_SPREAD = 1.0, 0.5
"""Bounds of what drivers are offered beside what they accept: means this many standard deviations apart, logarithms of
the deviation of the closing speed this far. Without them I-80's starts, by half a unit of log likelihood, would be one
in six of offers with a mean closing speed of 7 m/s; with them more than half of all offers are accepted, as in the gap
acceptance of Toledo (2003) and Ahmed (1999), 0.62 to 0.89 at the recorded starts of both sites."""
ACCEPTED_ORDER = ("cut_in_speed", "cut_in_gap", "ego_speed", "lead_speed", "lead_gap", "lateral_offset", "duration")
ACCEPTED_KINDS = {"cut_in_gap": "log", "lead_gap": "log", "duration": "log"}


class PairFit(NamedTuple):
    """Closing speed and log gap, with what drivers accept."""

    mean: FloatArray
    """(2,)."""
    covariance: FloatArray
    """(2, 2)."""
    limit: float
    """b [m/s^2], inf for no factor."""
    log_likelihood: float


class _Pair:
    """The likelihood of closing speeds [m/s] and gaps [m], (n,) each, in a range of gaps."""

    def __init__(self, closing: FloatArray, gap: FloatArray, ends: tuple[float, float]) -> None:
        self.closing, self.gap, self.y, self.ends = closing, gap, np.log(gap), np.log(ends)
        self.centre = np.array([closing.mean(), self.y.mean()])
        self.scale = np.array([closing.std(), self.y.std()])
        # nodes: closing speeds from 0 up, and log gaps of the range
        top = closing.mean() + 8.0 * closing.std() + 5.0
        self.dv, self.dv_weights = 0.5 * top * (NODES + 1.0), 0.5 * top * WEIGHTS
        low, high = self.ends
        self.node, self.node_weights = 0.5 * (low + high) + 0.5 * (high - low) * NODES, 0.5 * (high - low) * WEIGHTS

    def moments(self, p: FloatArray) -> tuple[float, float, float, float, float]:
        """Return mean and sd of the closing speed; intercept, slope and sd of the log gap given it."""
        mean, sd = self.centre[0] + p[0] * self.scale[0], self.scale[0] * np.exp(p[1])
        slope = p[3] * self.scale[1] / self.scale[0]
        intercept = self.centre[1] + p[2] * self.scale[1] - slope * self.centre[0]
        return mean, sd, intercept, slope, self.scale[1] * np.exp(p[4])

    def log_likelihood(self, p: FloatArray, limit: float) -> float:
        """Return the log likelihood in units of closing speed and log gap."""
        mean, sd, intercept, slope, rest = self.moments(p)

        def log_gap(y: FloatArray, closing: FloatArray) -> FloatArray:
            middle = intercept + slope * closing
            mass = ndtr((self.ends[1] - middle) / rest) - ndtr((self.ends[0] - middle) / rest)
            z = (y - middle) / rest
            return np.asarray(-0.5 * z * z - np.log(rest * np.maximum(mass, 1e-300)))

        z = (self.closing - mean) / sd
        value = (-0.5 * z * z).sum() - len(z) * np.log(sd * 2.0 * np.pi) + log_gap(self.y, self.closing).sum()
        if np.isinf(limit):
            return float(value)
        density = np.exp(-0.5 * ((self.dv - mean) / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))
        inner = np.exp(log_gap(self.node, self.dv[:, None])) * self._accepted(limit)
        accepted = density * (inner * self.node_weights).sum(axis=1) / np.sqrt(2.0 * np.pi)
        share = ndtr(-mean / sd) + (accepted * self.dv_weights).sum()
        value += log_acceptance(self.gap, self.closing, limit).sum() - len(z) * np.log(share)
        return float(value)

    def _accepted(self, limit: float) -> FloatArray:
        """Return A at the nodes (closing speeds, log gaps)."""
        return np.asarray(np.exp(log_acceptance(np.exp(self.node), self.dv[:, None], limit)))

    def climb(self, limit: float | None, start: float = np.inf) -> PairFit:
        """Return the likeliest pair, with a given limit or from a start of its own."""
        first = np.zeros(5) if limit is not None else np.append(np.zeros(5), np.log(start))
        first[3] = float(np.corrcoef(self.closing, self.y)[0, 1])
        first[4] = 0.5 * np.log1p(-(first[3] ** 2))

        def loss(p: FloatArray) -> float:
            return -self.log_likelihood(p[:5], float(np.exp(p[5])) if limit is None else limit)

        shift, spread = (-MOST_SHIFT, MOST_SHIFT), (-MOST_SPREAD, MOST_SPREAD)
        bounds = [shift, spread, shift, (-3.0, 3.0), (-3.0, 1.0)]
        bounds += [(np.log(LEAST_LIMIT), np.log(MOST_LIMIT))] if limit is None else []
        found = minimize(loss, first, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-9})
        mean, sd, intercept, slope, rest = self.moments(found.x[:5])
        cross = slope * sd * sd
        covariance = np.array([[sd * sd, cross], [cross, rest * rest + slope * cross]])
        b = float(np.exp(found.x[5])) if limit is None else limit
        return PairFit(np.array([mean, intercept + slope * mean]), covariance, b, -float(found.fun))


def fit_pair(closing: FloatArray, gap: FloatArray, ends: tuple[float, float]) -> PairFit:
    """Return the likeliest distribution of closing speeds [m/s] and gaps [m], (n,) each, with gaps between two ends.

    Args:
        closing: Speed behind less speed of the cutter.
        gap: Bumper to bumper, within the ends.
        ends: Of the scenario's range.

    Example:
        >>> rng = np.random.default_rng(0)
        >>> gap, closing = rng.lognormal(2.8, 0.7, 2000), rng.normal(0.0, 2.0, 2000)
        >>> kept = (gap > 1.0) & (rng.random(2000) < np.exp(log_acceptance(gap, closing, 0.5)))
        >>> 0.3 < fit_pair(closing[kept], gap[kept], (1.0, 120.0)).limit < 0.8
        True
    """
    pair = _Pair(closing, gap, ends)
    return max((pair.climb(None, start) for start in STARTS), key=lambda fit: fit.log_likelihood)


def profile_limit(closing: FloatArray, gap: FloatArray, ends: tuple[float, float]) -> dict[str, float]:
    """Return by b how much its log likelihood is above that without the factor, all else fitted again."""
    pair = _Pair(closing, gap, ends)
    without = pair.climb(np.inf).log_likelihood
    return {f"{b:g}": round(pair.climb(b).log_likelihood - without, 2) for b in PROFILE}


def check_starts_vary(joint: FloatArray, apart: FloatArray, parameters: Sequence[Parameter]) -> None:
    """Raise a `NoSpread` if a parameter of starts, or the closing speed, is nearly constant; as `fit_accepted`."""
    closing = replace(parameters[0], name="ego_speed - cut_in_speed")
    check_spread(np.column_stack([joint, joint[:, 0] - joint[:, 1]]), (*parameters[:5], closing))
    check_spread(apart, parameters[5:])


def fit_accepted(joint: FloatArray, apart: FloatArray, parameters: tuple[Parameter, ...]) -> AcceptedGaps:
    """Return accepted gaps fitted to starts.

    Args:
        joint: ego_speed, cut_in_speed, lead_speed, cut_in_gap and lead_gap of starts, (n, 5).
        apart: lateral_offset and duration of lane changes, which are independent of the others, (m, 2).
        parameters: Of these seven.

    Raises:
        NoSpread: A parameter or the closing speed is nearly constant.
    """
    names = tuple(p.name for p in parameters)
    check_starts_vary(joint, apart, parameters)
    ego, cutter, lead, gap, lead_gap = joint.T
    ends = {p.name: (p.low, p.high) for p in parameters}
    pair = fit_pair(ego - cutter, gap, ends["cut_in_gap"])
    rest = np.column_stack([ego, lead, np.log(lead_gap)])
    given = np.column_stack([ego - cutter, np.log(gap)])
    design = np.column_stack([np.ones(len(given)), given])
    coefficients = np.linalg.lstsq(design, rest, rcond=None)[0]
    residual = rest - design @ coefficients
    own = residual.T @ residual / len(rest) + COVARIANCE_FLOOR * np.diag(rest.var(axis=0))
    slopes = coefficients[1:].T
    side = np.column_stack([apart[:, 0], np.log(apart[:, 1])])
    covariance = np.zeros((7, 7))
    covariance[:2, :2], covariance[2:5, :2] = pair.covariance, slopes @ pair.covariance
    covariance[:2, 2:5] = covariance[2:5, :2].T
    covariance[2:5, 2:5] = own + slopes @ pair.covariance @ slopes.T
    covariance[5:, 5:] = np.cov(side.T, ddof=0) + COVARIANCE_FLOOR * np.diag(side.var(axis=0))
    mean = np.concatenate([pair.mean, coefficients[0] + slopes @ pair.mean, side.mean(axis=0)])
    low, high = (np.array([ends[name][end] for name in names]) for end in (0, 1))
    low[1], high[1] = ends["ego_speed"][0] - ends["cut_in_speed"][1], ends["ego_speed"][1] - ends["cut_in_speed"][0]
    coordinates = Coordinates(
        low=low,
        high=high,
        kinds=tuple(ACCEPTED_KINDS.get(name, "plain") for name in names),  # type: ignore[misc]  # "plain" or "log"
        names=names,
        order=ACCEPTED_ORDER,
        within=(Difference("ego_speed", "cut_in_speed", *ends["cut_in_speed"]),),
    )
    rounded = np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[np.float64])
    mixture = TruncatedGaussianMixture(
        np.ones(1), rounded(mean)[None], rounded(covariance)[None], coordinates=coordinates
    )
    return AcceptedGaps(mixture, float(f"{pair.limit:.4g}"))
