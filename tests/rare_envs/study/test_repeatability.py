"""Egos whose f is no function of x are noticed at the end of a run, and others are not suspected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import agents
from rare_envs.study import Question, prepare, run
from rare_envs.study.evaluate import KEPT_ROWS, ROWS_ALONE

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
