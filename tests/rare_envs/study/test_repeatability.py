"""Egos whose f is no function of x are noticed at the end of a run, and others are not suspected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import agents
from rare_envs.study import Question, prepare, run
from rare_envs.study.evaluate import KEPT_ROWS, ROWS_ALONE, RowKeeper
from samplers.evaluate import Simulated

QUESTION = Question(
    env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=300
)


class Braking:
    """Brakes by a share of what is asked for; the share is what goes wrong in others."""

    calls = 0

    def predict(self, observation: Any, state: Any = None, **_: Any) -> Any:
        self.calls += 1
        share = np.broadcast_to(self.share(np.asarray(observation)), len(observation))
        return np.stack((-share, np.zeros_like(share)), axis=1).astype(np.float32), None

    def share(self, observation: np.ndarray) -> Any:
        return np.clip(observation.sum(axis=1), 0.0, 1.0)


class RandomLater(Braking):
    def share(self, observation: np.ndarray) -> Any:
        rng = np.random.default_rng(self.calls if self.calls > 4 else 0)
        return rng.random(len(observation))


class Counting(Braking):
    def share(self, observation: np.ndarray) -> Any:
        return min(1.0, self.calls / 100.0)


class Mixing(Braking):
    def share(self, observation: np.ndarray) -> Any:
        return np.clip(0.5 + (seen := observation.sum(axis=1)) - seen.mean(), 0.0, 1.0)


@pytest.mark.parametrize("ego", [RandomLater, Counting, Mixing])
def test_an_ego_without_an_f_is_noticed(ego: type[Braking]) -> None:
    report = run(prepare(QUESTION, ego=ego()))
    assert report.doubtful
    (warning,) = (text for text in report.warnings if "done again in another order and company" in text)
    assert f"of {KEPT_ROWS + ROWS_ALONE} simulations" in warning
    answer = report.to_dict()
    assert answer["repeatability"]["n_differing"] > 3 and warning in answer["doubts"]


@pytest.mark.parametrize("ego", [Braking(), "imitation"])
def test_others_are_not_suspected(ego: Any) -> None:
    found = run(prepare(QUESTION, ego=agents.load_ego(ego) if isinstance(ego, str) else ego)).repeatability
    assert found is not None
    assert (found.n, found.n_differing, found.warning) == (KEPT_ROWS + ROWS_ALONE, 0, "")


def test_every_row_has_the_same_chance_to_be_kept() -> None:
    """400 samples of 4 of 10 rows, one of which has no f: each is kept in 4 of 9, five standard errors allowed."""
    counts = np.zeros(10)
    for seed in range(400):
        keeper = RowKeeper(1, gamma=3.2, size=8)
        keeper._rng = np.random.default_rng(seed)
        for part in (np.arange(3), np.arange(3, 9), np.arange(9, 10)):
            x = part[:, None].astype(float)
            keeper.keep(Simulated(x, np.where(part == 5, np.nan, part).astype(float), [], np.zeros(len(x))))
        np.testing.assert_array_equal(keeper.x[:, 0], keeper.f)
        np.testing.assert_array_equal(keeper.f[4:], [3, 4, 2, 1])
        counts[keeper.f[:4].astype(int)] += 1
    expected = 400 * 4 / 9
    assert counts[5] == 0
    assert np.abs(np.delete(counts, 5) - expected).max() < 5 * (expected * 5 / 9) ** 0.5
