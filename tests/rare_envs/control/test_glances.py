"""Glances away from the road have the published durations and share of time."""

import math

import numpy as np
import pytest
import torch

from rare_envs.control.human_driver import (
    GLANCE_CDF,
    MEAN_GLANCE,
    MEAN_ON_ROAD,
    OFF_ROAD_SHARE,
    Glances,
    count_glance_draws,
    count_glances,
    draw_glances,
    glance_duration,
    remaining_duration,
)

N, HORIZON = 40_000, 10.0


@pytest.fixture(scope="module")
def glances() -> Glances:
    generator = torch.Generator().manual_seed(0)
    return draw_glances(torch.randn(N, count_glance_draws(HORIZON), generator=generator, dtype=torch.float64))


def test_the_quantiles_are_the_published_ones() -> None:
    duration, share = (torch.tensor(column, dtype=torch.float64) for column in zip(*GLANCE_CDF, strict=True))
    torch.testing.assert_close(glance_duration(share), duration)
    halfway = (share[:-1] + share[1:]) / 2
    torch.testing.assert_close(glance_duration(halfway), (duration[:-1] + duration[1:]) / 2)


def test_durations_have_the_published_distribution(glances: Glances) -> None:
    lasting = (glances.end - glances.start)[:, 1]
    for duration, share in GLANCE_CDF:
        found = float((lasting <= duration).double().mean())
        assert abs(found - share) < 5 * math.sqrt(share * (1 - share) / N) + 1e-12
    assert float(lasting.mean()) == pytest.approx(MEAN_GLANCE, rel=0.02)
    assert pytest.approx(0.863, abs=0.005) == MEAN_GLANCE  # of the counts, without interpolation


def test_the_eyes_are_off_the_road_for_the_published_share_at_all_times(glances: Glances) -> None:
    for time in (0.0, 0.5, 3.0, 9.9):
        share = float(glances.off_road(time).double().mean())
        assert abs(share - OFF_ROAD_SHARE) < 5 * math.sqrt(OFF_ROAD_SHARE / N)
    assert MEAN_GLANCE / (MEAN_GLANCE + MEAN_ON_ROAD) == pytest.approx(OFF_ROAD_SHARE)


def test_what_is_left_of_a_glance_is_that_of_a_stationary_sequence(glances: Glances) -> None:
    """By the sequence itself: at 5 s, long after its beginning, the rest of a glance that is under way."""
    under_way = (glances.start <= 5.0) & (5.0 < glances.end) & (glances.start > 0.0)
    left = (glances.end - 5.0)[under_way].numpy()
    shares = np.array([0.1, 0.5, 0.9])
    expected = remaining_duration(torch.from_numpy(shares)).numpy()
    found = np.array([(left <= each).mean() for each in expected])
    assert (np.abs(found - shares) < 5 * np.sqrt(shares * (1 - shares) / len(left))).all()


def test_enough_glances_are_drawn(glances: Glances) -> None:
    assert glances.start.shape == (N, count_glances(HORIZON) + 1)
    assert float((glances.start[:, -1] < HORIZON).double().mean()) < 1e-4


def test_glances_are_numbered_as_they_begin() -> None:
    one = Glances(torch.tensor([[0.0, 2.0]]), torch.tensor([[0.0, 3.0]]))
    assert [one.number_at(time).item() for time in (0.0, 1.9, 2.0)] == [1, 1, 2]
    assert [one.off_road(time).item() for time in (0.0, 2.0, 2.9, 3.0)] == [False, True, True, False]
