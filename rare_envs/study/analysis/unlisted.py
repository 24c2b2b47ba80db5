"""Unlisted failures: the most likely failure of each mode and kind of crash that the list of failures lacks.

A run keeps its most likely failures. A kind of crash that is rarer than all of them has a share of p, and would have no
failure to look at, to replay or to keep as a regression test.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import samplers
from rare_envs.distributions.space import ScenarioSpace
from rare_envs.study.analysis.failure_replay import MAX_REPLAYED
from rare_envs.study.analysis.modes import assign_modes
from rare_envs.study.storage.episode_file import digest_scenario
from samplers.analysis import NO_OUTCOME_LABEL
from samplers.analysis.base import require_sample
from samplers.analysis.failure_weights import choose_failures
from samplers.problem import FloatArray


def list_every_mode(
    space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]
) -> tuple[samplers.Estimate, NDArray[np.int64]]:
    """Return an estimate whose list of failures has one of each mode and kind of crash, and where the new ones stand.

    Args:
        space: Of x.
        estimate: The run.
        crashes: Kinds of crash of its failures, by `digest_scenario`.
    """
    if estimate.failures.total <= len(estimate.failures) or estimate.sample is None or estimate.p <= 0:
        return estimate, np.empty(0, dtype=np.int64)
    longer = _append(estimate, _find_kinds(estimate, crashes))
    longer = _append(longer, _find_modes(space, longer, crashes))
    known = {digest_scenario(x) for x in estimate.failures.x}
    added = [k for k, x in enumerate(longer.failures.x) if digest_scenario(x) not in known]
    return longer, np.array(added, dtype=np.int64)


def _find_kinds(estimate: samplers.Estimate, crashes: Mapping[str, str]) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: the most likely failure of each kind of crash that the list lacks."""
    sample = require_sample(estimate)
    rows = choose_failures(sample, estimate.gamma, MAX_REPLAYED)
    kinds = np.array([crashes.get(digest_scenario(x), "") for x in sample.x[rows]], dtype=object)
    listed = {crashes.get(digest_scenario(x), "") for x in estimate.failures.x}
    return _pick_likely(estimate, rows, kinds, {*listed, ""})


def _find_modes(space: ScenarioSpace, estimate: samplers.Estimate, crashes: Mapping[str, str]) -> NDArray[np.int64]:
    """Return rows of `Sample.x`: the most likely labelled failure of each mode that the list lacks."""
    found = assign_modes(space, estimate, crashes)
    if found is None:
        return np.empty(0, dtype=np.int64)
    return _pick_likely(estimate, found.rows, found.labels, {*found.listed, f"{NO_OUTCOME_LABEL}/0", "/0"})


def _append(estimate: samplers.Estimate, rows: NDArray[np.int64]) -> samplers.Estimate:
    """Return an estimate with some rows of `Sample.x` in its list of failures too."""
    if not len(rows):
        return estimate
    sample, failures = require_sample(estimate), estimate.failures
    x, f = sample.x[rows], sample.f[sample.f <= estimate.gamma][rows]
    more = failures.merge(x, f, _log_density(estimate, x), keep=len(failures) + len(rows))
    return replace(estimate, failures=replace(more, total=failures.total))


def _pick_likely(
    estimate: samplers.Estimate, rows: NDArray[np.int64], labels: NDArray[np.object_], known: set[Any]
) -> NDArray[np.int64]:
    """Return the most likely of the rows of each label that is not known."""
    log_density = _log_density(estimate, require_sample(estimate).x[rows])
    missing = [labels == label for label in dict.fromkeys(labels.tolist()) if label not in known]
    best = [np.argmax(np.where(mine, log_density, -np.inf)) for mine in missing]
    return rows[np.array(best, dtype=np.int64)]


def _log_density(estimate: samplers.Estimate, x: FloatArray) -> FloatArray:
    """Return the logarithm of the base density at points x (k, d), shape (k,)."""
    if estimate.base is None:
        raise ValueError("The estimate does not know its base distribution.")
    return np.asarray(estimate.base.log_prob(x), dtype=np.float64)
