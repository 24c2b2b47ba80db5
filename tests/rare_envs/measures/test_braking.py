"""Braking: the least that does not touch, and the last moment for it, against motion in small steps."""

import numpy as np
import pytest
import torch

from rare_envs.measures import (
    DECELERATION_MAX,
    TTC_MAX,
    evasive_manoeuvre,
    required_deceleration,
    ttb,
)
from tests.rare_envs.measures.moments import TIME, drives, following, path


def test_required_deceleration_is_the_least_that_does_not_touch() -> None:
    for gap, speed, lead_speed, _, its in drives(np.random.default_rng(2), 60):
        needed = required_deceleration(following(gap, speed, lead_speed, 0.0, its)).item()
        lead = path(lead_speed, min(its, 0.0), True)
        if 1.0 < needed < DECELERATION_MAX:
            assert (gap + lead - path(speed, -1.001 * needed - 1e-3, True)).min() > 0
            assert (gap + lead - path(speed, -0.99 * needed, True)).min() < 0


def test_a_swerve_is_as_rapid_as_its_lateral_acceleration() -> None:
    """At 20 m/s a turn by 0.03 rad in a tick of 0.1 s is 6 m/s^2 across, 6 / (0.4 g) of what makes a near-crash."""
    now = following(25.0, 20.0, 20.0, 0.0, 0.0)
    assert now.before is not None
    turned = now.state._replace(heading=now.state.heading + torch.tensor([0.03, 0.0]))
    assert evasive_manoeuvre(now._replace(state=turned)).item() == pytest.approx(6.0 / (0.4 * 9.80665), rel=1e-6)


def test_time_to_brake_is_the_last_moment_to_brake() -> None:
    for gap, speed, lead_speed, _, _ in drives(np.random.default_rng(3), 60):
        wait = ttb(following(gap, speed, lead_speed)).item()
        for late, touches in ((-0.01, False), (0.01, True)):
            if 0.0 < wait + late < TTC_MAX - 0.01:
                braking = np.clip(TIME - wait - late, 0.0, speed / 5.0)
                ego = speed * np.minimum(TIME, wait + late) + speed * braking - 2.5 * braking**2
                assert ((gap + lead_speed * TIME - ego).min() < 0) == touches
