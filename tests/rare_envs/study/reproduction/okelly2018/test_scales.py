"""Numbers of rollouts."""

from rare_envs.study.reproduction.okelly2018.scales import (
    PRINTED_SEARCH,
    SEARCHES,
    STUDY_SCALES,
    THRESHOLDS,
)


def test_the_full_scale_is_the_papers() -> None:
    full = STUDY_SCALES["lidar", "full"]
    assert (full.per_search, full.naive) == (600_000, 1_300_000)
    assert full.rollouts == 1_300_000 + 4 * 600_000 + 4 * full.own
    assert SEARCHES[PRINTED_SEARCH].rho == 0.01


def test_thresholds_grow() -> None:
    for gammas in THRESHOLDS.values():
        assert list(gammas) == sorted(gammas)
