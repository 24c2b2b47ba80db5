from __future__ import annotations

import numpy as np
import pytest

import samplers
from rare_envs.study.episodes import digest_scenario
from rare_envs.study.modes import cluster_points, find_modes, label_modes
from rare_envs.traffic.crash import CRASH_KINDS
from samplers.analysis import NO_OUTCOME_LABEL
from samplers.problem import FloatArray


def tail(rng: np.random.Generator, n: int, dim: int, axis: int, sign: float) -> FloatArray:
    """Failures of a half-space at a distance of 3: the tail of a normal distribution."""
    u = rng.standard_normal((n, dim))
    u[:, axis] = sign * (3.0 + rng.exponential(1 / 3, n))
    return u


@pytest.mark.parametrize(("n", "dim"), [(12, 2), (400, 6)])
def test_one_region_is_one_cluster_and_two_are_two(n: int, dim: int) -> None:
    rng = np.random.default_rng(n + dim)
    assert not cluster_points(tail(rng, n, dim, 0, 1.0)).any()
    both = np.vstack([tail(rng, n, dim, 0, 1.0), tail(rng, n, dim, 0, -1.0)])
    found = cluster_points(both)
    assert len(set(found[:n])) == 1 and len(set(found[n:])) == 1 and found[0] != found[-1]


def test_kinds_of_crash_are_never_in_one_mode() -> None:
    rng = np.random.default_rng(0)
    kinds = np.array(["side", "rear_end", NO_OUTCOME_LABEL] * 20, dtype=object)
    labels = label_modes(rng.standard_normal((60, 2)), kinds)
    assert {(label, kind) for label, kind in zip(labels, kinds, strict=True)} == {
        (f"{kind}/0", kind) for kind in ("side", "rear_end", NO_OUTCOME_LABEL)
    }


class Plane:
    """Two parameters in standard normal space: what `find_modes` needs of a space."""

    names = column_names = ("a", "b")
    sizes, units = (1, 1), ("m", "")

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        return x


@pytest.mark.parametrize("method", ["mc", "two-stage"])
def test_shares_of_modes_add_up_to_p_and_name_their_most_likely_failure(method: str) -> None:
    problem = samplers.FunctionProblem(lambda x: np.minimum(2.0 - x[:, 0], 2.5 + x[:, 0]), dim=2)
    estimate = samplers.estimate(problem, method, seed=0, max_sim=20_000 if method == "mc" else 4000)
    assert estimate.sample is not None
    points = np.vstack([estimate.sample.x, estimate.failures.x])
    crashes = {digest_scenario(x): "side" for x in points}
    modes = find_modes(Plane(), estimate, crashes)  # type: ignore[arg-type]
    assert sum(mode.share.p for mode in modes) == pytest.approx(estimate.p, rel=1e-9)
    assert len(modes) == 2 and {mode.crash for mode in modes} == {"side"} <= set(CRASH_KINDS)
    # Phi(-2) = 0.02275 and Phi(-2.5) = 0.00621: 79 % and 21 %; each interval holds its own with probability 0.95
    for mode, truth in zip(modes, (0.02275, 0.00621), strict=True):
        assert mode.share.p == pytest.approx(truth, abs=4 * mode.share.cov * mode.share.p)
    signs = [np.sign(mode.center["a"]) for mode in modes]
    assert signs == [1.0, -1.0]
    for mode, sign in zip(modes, signs, strict=True):
        side = np.flatnonzero(np.sign(estimate.failures.x[:, 0]) == sign)
        assert mode.failure == (side[0] if len(side) else None)
