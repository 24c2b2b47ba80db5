"""Unlisted failures: a rare mode has its most likely failure in the list."""

from __future__ import annotations

import numpy as np
import pytest

import samplers
from rare_envs.study.episodes import digest_scenario
from rare_envs.study.modes import find_modes, list_every_mode
from samplers.problem import FloatArray


class Plane:
    """Two parameters in standard normal space: what is needed of a space."""

    names = column_names = ("a", "b")
    sizes, units = (1, 1), ("m", "")

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        return x


@pytest.fixture(scope="module")
def run() -> tuple[samplers.Estimate, dict[str, str]]:
    """p = Phi(-1.5) to the right, Phi(-3) to the left: 15 % of the failures kept are the most likely ones."""
    problem = samplers.FunctionProblem(lambda x: np.minimum(1.5 - x[:, 0], 3.0 + x[:, 0]), dim=2)
    estimate = samplers.estimate(problem, "mc", seed=1, max_sim=40_000)
    assert estimate.sample is not None and estimate.failures.total > len(estimate.failures) == 1000
    points = np.vstack([estimate.sample.x, estimate.failures.x])
    return estimate, {digest_scenario(x): "side" if x[0] > 0 else "rear_end" for x in points}


def test_a_kind_beyond_the_list_gets_its_most_likely_failure(
    run: tuple[samplers.Estimate, dict[str, str]],
) -> None:
    estimate, crashes = run
    assert {crashes[digest_scenario(x)] for x in estimate.failures.x} == {"side"}
    assert [mode.failure for mode in find_modes(Plane(), estimate, crashes)] == [0, None]  # type: ignore[arg-type]
    longer, added = list_every_mode(Plane(), estimate, crashes)  # type: ignore[arg-type]
    assert added.tolist() == [1000] and longer.failures.total == estimate.failures.total
    assert (np.diff(longer.failures.log_p0) <= 0).all()
    rare = estimate.sample.x[estimate.sample.x[:, 0] < 0]  # type: ignore[union-attr]
    likely = rare[np.argmin((rare**2).sum(axis=1))]
    assert (longer.failures.x[1000] == likely).all() and longer.failures.f[1000] == 3.0 + likely[0]
    assert [mode.failure for mode in find_modes(Plane(), longer, crashes)] == [0, 1000]  # type: ignore[arg-type]
    again, more = list_every_mode(Plane(), longer, crashes)  # type: ignore[arg-type]
    assert again is longer and not len(more)
