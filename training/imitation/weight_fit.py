"""Distribution of the last layers' weights of an ensemble, by graphical lasso.

A few dozen members say next to nothing about most of the 81,406 correlations of 404 weights. So the correlations are
first shrunk towards 0, the graphical lasso keeps the dependences that stand out, and the penalty that decides how many
it keeps is the one with the greatest likelihood of held-out members.

References:
    Friedman, Hastie and Tibshirani, "Sparse inverse covariance estimation with the graphical lasso", Biostatistics
    9, 2008.
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4.
"""

import contextlib
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from sklearn.covariance import graphical_lasso
from sklearn.exceptions import ConvergenceWarning

from agents.learned.weight_distribution import RADIUS, WEIGHT_NAMES, WeightDistribution
from samplers.problem import FloatArray

PENALTIES = (0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.1)
"""Penalties on correlations, in the order they are tried; with `SHRINKAGE` the first keeps no dependence."""
SHRINKAGE = 0.25
"""Share of the identity that is mixed into the correlations."""
FOLDS = 5
"""Number of parts that members are held out in."""
DUALITY_GAP = 0.05
"""Duality gap [nats] at which the lasso has converged: far less than the likelihoods of two penalties differ by."""
INNER_TOLERANCES = (1e-6, 1e-4)
"""Tolerances of the lasso's inner problems: the first needs fewer rounds, the second succeeds where the first fails."""
_FAILURES = (FloatingPointError, ConvergenceWarning, RuntimeWarning, np.linalg.LinAlgError)
"""Exceptions of the lasso if it has no answer, or one that is not positive definite."""


class WeightFit(NamedTuple):
    """A fitted distribution and a record of the fit."""

    distribution: WeightDistribution
    metadata: dict[str, Any]
    """Record of the fit, ready for JSON: members, folds, shrinkage, penalty (chosen), nonzeros (share of the
    off-diagonal entries of the precision), condition (of the precision of standardised weights), spread_median,
    spread_max, stopped (why no smaller penalty was tried), tried: for each penalty its nonzeros, condition and
    held-out log-likelihood per member."""


def fit_weights(
    members: FloatArray,
    *,
    radius: float = RADIUS,
    penalties: Sequence[float] = PENALTIES,
    shrinkage: float = SHRINKAGE,
    folds: int = FOLDS,
    names: Sequence[str] = WEIGHT_NAMES,
) -> WeightFit:
    """Return the Gaussian N(mean, precision^-1) fitted to the weights of an ensemble.

    Penalties are tried in descending order until one fails, on all members or without one of the folds; the one with
    the greatest held-out log-likelihood is taken.

    Args:
        members: Last layers of K drivers, shape (K, 404). Members that depend on each other (iterates of one run) must
            be neighbours, because a fold holds out consecutive members.
        radius: Distance by which a search may move each mean.
        penalties: Penalties to try, in descending order.
        shrinkage: Share of the identity mixed into the correlations.
        folds: Number of times that members are held out.
        names: Names of the columns in error messages.

    Raises:
        ValueError: There are too few members, a weight is not finite or the same in all members of a fit, or not even
            the first penalty succeeds.

    Example:
        >>> members = np.random.default_rng(0).standard_normal((20, 3))
        >>> fit = fit_weights(members, names=("a", "b", "c"))
        >>> fit.metadata["members"], fit.distribution.mean.shape
        (20, (3,))
    """
    members = np.asarray(members, dtype=np.float64)
    _check_arguments(members, penalties, shrinkage, folds, names)
    everyone = _moments(members, shrinkage, names)
    held_out = np.array_split(np.arange(len(members)), folds)
    without = [_moments(np.delete(members, fold, axis=0), shrinkage, names) for fold in held_out]

    tried: list[dict[str, float]] = []
    precisions: list[FloatArray] = []
    stopped = "no penalty left"
    for penalty in penalties:
        try:
            precision = _lasso(everyone.correlation, penalty)
            fitted = [_to_distribution(part, _lasso(part.correlation, penalty), radius) for part in without]
        except _FAILURES as failure:
            stopped = f"penalty {penalty} failed: {' '.join(str(failure).split())[:120]}"
            break
        scores = np.concatenate([part.log_prob(members[fold]) for part, fold in zip(fitted, held_out, strict=True)])
        likelihood = {"penalty": float(penalty), "held_out_log_likelihood": float(scores.mean())}
        tried.append({**likelihood, **_describe_precision(precision)})
        precisions.append(precision)
    if not tried:
        raise ValueError(f"No distribution could be fitted: {stopped}. Start at a larger penalty or shrink more.")
    best = int(np.argmax([row["held_out_log_likelihood"] for row in tried]))
    metadata = {
        "members": len(members),
        "folds": folds,
        "shrinkage": shrinkage,
        **{name: tried[best][name] for name in ("penalty", "held_out_log_likelihood", "nonzeros", "condition")},
        "spread_median": float(np.median(everyone.spread)),
        "spread_max": float(everyone.spread.max()),
        "stopped": stopped,
        "tried": tried,
    }
    return WeightFit(_to_distribution(everyone, precisions[best], radius), metadata)


def _check_arguments(
    members: FloatArray, penalties: Sequence[float], shrinkage: float, folds: int, names: Sequence[str]
) -> None:
    """Raise ValueError for arguments of `fit_weights` that do not fit together."""
    if members.ndim != 2 or members.shape[1] != len(names):
        raise ValueError(f"Expected members of shape (K, {len(names)}), got {members.shape}.")
    if folds < 2 or len(members) < 2 * folds:
        raise ValueError(f"Expected at least 2 folds of 2 members each, got {len(members)} members in {folds} folds.")
    if not 0.0 < shrinkage < 1.0 or list(penalties) != sorted(penalties, reverse=True) or not penalties:
        raise ValueError(f"Expected shrinkage in (0, 1) and descending penalties, got {shrinkage} and {penalties}.")


class _Moments(NamedTuple):
    """Moments of the weights of members, of shape (404,) and (404, 404)."""

    mean: FloatArray
    spread: FloatArray
    """Standard deviations."""
    correlation: FloatArray
    """Correlations, shrunk towards the identity."""


def _moments(members: FloatArray, shrinkage: float, names: Sequence[str]) -> _Moments:
    """Return the moments of members.

    Raises:
        ValueError: A weight is not finite, or the same in all members.
    """
    inert = ~np.isfinite(members).all(axis=0) | (members == members[0]).all(axis=0)
    if inert.any():
        some = ", ".join(names[j] for j in np.flatnonzero(inert)[:5])
        raise ValueError(
            f"Expected every weight to vary among the members, but {inert.sum()} of {len(names)} are inert "
            f"(the same in all, or not finite): {some}{', ...' if inert.sum() > 5 else ''}. "
            "Does a clamp keep gradients from them?"
        )
    mean, spread = members.mean(axis=0), members.std(axis=0, ddof=1)
    normal = (members - mean) / spread
    correlation = (1.0 - shrinkage) * normal.T @ normal / (len(members) - 1)
    np.fill_diagonal(correlation, 1.0)
    return _Moments(mean, spread, correlation)


def _lasso(correlation: FloatArray, penalty: float) -> FloatArray:
    """Return the sparse precision of standardised weights.

    Raises:
        Exception: One of `_FAILURES`, if the solver succeeds with none of the inner tolerances.
    """
    for tolerance in INNER_TOLERANCES[:-1]:
        with contextlib.suppress(*_FAILURES):
            return _solve_lasso(correlation, penalty, tolerance)
    return _solve_lasso(correlation, penalty, INNER_TOLERANCES[-1])


def _solve_lasso(correlation: FloatArray, penalty: float, tolerance: float) -> FloatArray:
    """Return the precision at one inner tolerance."""
    state = np.random.get_state()  # noqa: NPY002 - scikit-learn draws a number that nothing depends on
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            _, precision = graphical_lasso(correlation, penalty, tol=DUALITY_GAP, enet_tol=tolerance)
    finally:
        np.random.set_state(state)  # noqa: NPY002
    np.linalg.cholesky(precision)
    return np.asarray(precision, dtype=np.float64)


def _to_distribution(moments: _Moments, precision: FloatArray, radius: float) -> WeightDistribution:
    """Return the distribution with a precision of standardised weights."""
    return WeightDistribution(moments.mean, precision / np.outer(moments.spread, moments.spread), radius)


def _describe_precision(precision: FloatArray) -> dict[str, float]:
    """Return the share of nonzero off-diagonal entries, and the condition number."""
    beside = precision[~np.eye(len(precision), dtype=bool)]
    return {"nonzeros": float((beside != 0.0).mean()), "condition": float(np.linalg.cond(precision))}
