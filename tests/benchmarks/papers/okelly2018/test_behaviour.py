"""Behaviour of drives on the highway."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.papers.okelly2018.behaviour import (
    RunBehaviour,
    compare_behaviour,
    find_least_time,
    measure_behaviour,
)


def test_a_neighbour_that_drives_into_the_ego_is_danger_from_the_side(highway: Any) -> None:
    x = highway.base.sample(2, np.random.default_rng(0))
    x[:, :6] = (100.0, 81.0, 100.0, 119.0, 82.0, 118.0)  # the car on the left is beside the ego
    x[:, 12:18] = (0.0, 0.0, 3.5, 0.0, 0.0, 0.0)  # and comes over
    x[:, 18:24] = 15.0
    from rare_envs.simulation import drive

    with torch.inference_mode():
        first = next(iter(drive(highway.world, highway.driver, torch.from_numpy(x).float())))
        least, side = find_least_time(first)
    assert side.all()
    assert ((least > 0.5) & (least < 10.0)).all()


def test_values_of_drives(highway: Any) -> None:
    x = highway.base.sample(8, np.random.default_rng(1))
    found = measure_behaviour(highway, x)
    assert all(values.shape == (8,) for values in found)
    assert ((found.hard_brakes >= 0) & (found.hard_brakes <= 1)).all()
    assert set(found.sideways) | set(found.collided) <= {0.0, 1.0}


def test_more_of_everything_is_found() -> None:
    rng = np.random.default_rng(0)
    often, seldom = (RunBehaviour(*(rng.random((4, 300)) < share).astype(float)) for share in (0.6, 0.2))
    assert [each.verdict for each in compare_behaviour(often, seldom, often, 900)] == ["holds"] * 3
    assert "300 of 900 driven again" in compare_behaviour(often, seldom, often, 900)[2].statistic


@pytest.mark.parametrize("claim", range(3))
def test_equal_runs_show_nothing(claim: int) -> None:
    rng = np.random.default_rng(3)
    one, other = (RunBehaviour(*(rng.random((4, 300)) < 0.3).astype(float)) for _ in range(2))
    assert compare_behaviour(one, other, one, 300)[claim].verdict == "not seen here"
