"""A probe queries an ego with observations of ordinary scenarios."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import rare_envs
from rare_envs.study.ego_check.checks import BATCH_ROWS, Probe, largest_difference


class Counting:
    """Accelerates by the number of calls so far, which it carries in its state."""

    observation_space = action_space = None

    def predict(
        self, observation: NDArray[Any], state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        state = np.where(episode_start, 0.0, 0.0 if state is None else state) + 0.1
        return np.stack([state, np.zeros(len(observation))], axis=1), state


@pytest.fixture(scope="module")
def probe() -> Probe:
    problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", ego=Counting(), horizon=1.0)
    return Probe.of(problem.ego, problem)


def test_observations_are_those_of_the_environment(probe: Probe) -> None:
    assert probe.seen.shape == (BATCH_ROWS, *probe.space.shape)
    assert np.isfinite(probe.seen).all()
    assert np.unique(probe.seen, axis=0).shape[0] > BATCH_ROWS // 2


def test_transformed_observations_keep_their_type(probe: Probe) -> None:
    twice = probe.transform_seen(lambda part: part.astype(np.float64) * 2.0)
    assert twice.dtype == probe.seen.dtype
    np.testing.assert_array_equal(twice, probe.seen * 2)
    many = probe.repeat_seen(2 * BATCH_ROWS + 1)
    np.testing.assert_array_equal(many[BATCH_ROWS : 2 * BATCH_ROWS], probe.seen)
    assert len(many) == 2 * BATCH_ROWS + 1


def test_memory_is_carried_and_reset(probe: Probe) -> None:
    first, state = probe.query(probe.seen)
    second, state = probe.query(probe.seen, state)
    start = np.arange(BATCH_ROWS) == 0
    third, _ = probe.query(probe.seen, state, start)
    assert (first[0, 0], second[0, 0]) == pytest.approx((0.1, 0.2))
    assert third[:2, 0] == pytest.approx([0.1, 0.3])


@pytest.mark.parametrize(
    ("one", "other", "expected"),
    [
        ([1.0, 2.0], [1.0, 2.5], 0.5),
        ([1.0, np.nan], [1.0, np.nan], 0.0),
        ([1.0, np.nan], [1.0, 2.0], np.inf),
        ([1.0], [1.0, 2.0], np.inf),
        ([], [], 0.0),
    ],
)
def test_largest_difference(one: list[float], other: list[float], expected: float) -> None:
    assert largest_difference(np.array(one), np.array(other)) == expected
