"""Braking beside the teacher's: short brakings can be survived, and a lag is seen where there is one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import training.egos.braking_lag as braking_lag
from rare_envs import IDM, DrivingProblem
from training.egos.braking_lag import SCENARIO, SHORT_BRAKINGS, compare_braking, draw_short_brakings


class Late(IDM):
    """Brakes at all only after three ticks."""

    def act(self, episode: Any, memory: Any) -> tuple[Tensor, Any]:
        action, _ = super().act(episode, None)
        tick = memory or 0
        return (torch.zeros_like(action) if tick < 3 else action), tick + 1


def test_the_teacher_survives_all_brakings_that_are_drawn() -> None:
    x = draw_short_brakings(64, seed=1)
    low, high = np.array(SHORT_BRAKINGS).T
    assert 0 < len(x) < 64 and bool(((x >= low) & (x <= high)).all())
    lag = compare_braking(IDM(jam_distance=2.0), x)
    assert lag.collided == 0 and set(lag.driving.tolist()) == {len(x)}
    assert (DrivingProblem(SCENARIO, ego=IDM(max_deceleration=3.0)).evaluate(x) <= 0.0).any()  # there is no slack


def test_a_late_ego_is_seen_to_be_late() -> None:
    x = draw_short_brakings(16, seed=2)
    lag = compare_braking(Late(), x, seconds=1.0)
    assert lag.ego[:3] == pytest.approx(0.0, abs=1e-5) and lag.ego[3:5] == pytest.approx(-5.0, abs=1e-4)
    assert lag.teacher[:5] == pytest.approx(-5.0)
    assert compare_braking(Late(), x).collided > len(x) // 2


def test_the_table_has_a_row_for_each_tick(capsys: pytest.CaptureFixture[str]) -> None:
    braking_lag.main(ego="idm", brakings=8, seed=0)
    first, *rows = capsys.readouterr().out.splitlines()
    assert first.startswith("0 of ") and len(rows) == 2 + 25
    assert rows[2].startswith("| 0.0 | ") and rows[2].endswith(" | -5.00 | -5.00 |")
