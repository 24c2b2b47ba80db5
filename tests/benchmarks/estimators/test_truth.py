import pytest

from benchmarks.estimators.truth import ROLLOUT_CHUNK, count_collisions, truth

CAR_FOLLOWING = ("rare_envs/CarFollowing-v0", "highway")


@pytest.mark.slow
def test_counts_are_those_of_the_chunks_whatever_the_processes():
    rest = 5000
    found = truth(*CAR_FOLLOWING, ROLLOUT_CHUNK + rest, seed=7, workers=2)
    parts = [count_collisions(*CAR_FOLLOWING, 7, chunk, size) for chunk, size in enumerate((ROLLOUT_CHUNK, rest))]
    assert found["collisions"] == sum(parts)
    assert found["p"] == sum(parts) / (ROLLOUT_CHUNK + rest)


def test_chunks_are_drawn_on_their_own():
    assert len({count_collisions(*CAR_FOLLOWING, 7, chunk) for chunk in range(4)}) > 1
