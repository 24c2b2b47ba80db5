"""RSS by hand, and against the worst case that it is made for."""

import numpy as np
import pytest

from rare_envs.measures import (
    MARGIN_MAX,
    RSS,
    rss_lateral,
    rss_longitudinal,
    rss_margin,
)
from tests.rare_envs.measures.moments import TIME, following, moment


def test_rss_by_hand() -> None:
    now, rss = following(50.0, 20.0, 10.0), RSS()
    # (20 + 23.5) / 2 x 1 s + 23.5^2 / 8 - 10^2 / 16
    assert rss_longitudinal(now).item() == pytest.approx(50.0 - (21.75 + 69.03125 - 6.25))
    # level across: each may drift a rho^2 / 2 + (a rho)^2 / (2 b): 0.1 + 0.025 and 0.4 + 0.1 m, 0.1 m of wander
    assert rss_lateral(now).item() == pytest.approx(-0.725)
    assert rss_margin(now).item() == pytest.approx(-0.725)
    beside = moment((0.0, 0.0, 0.0, 20.0), (2.0, 4.0, 0.0, 20.0))
    assert rss_margin(beside).item() == pytest.approx(2.0 - 0.725)
    assert rss_longitudinal(beside).item() == MARGIN_MAX  # its lateral distance is safe
    behind = moment((0.0, 0.0, 0.0, 10.0), (-55.0, 0.0, 0.0, 20.0))  # it responds after 2 s
    assert rss_longitudinal(behind).item() == pytest.approx(50.0 - ((20 + 27) / 2 * 2 + 27**2 / 8 - 6.25))
    assert rss_longitudinal(now, RSS(response=0.0)).item() == pytest.approx(50.0 - (400 / 8 - 100 / 16))
    assert rss == RSS()


def test_rss_distance_is_just_enough_for_the_worst_case() -> None:
    """Both stop: the rear accelerates for its response time, then brakes gently, the front brakes hard."""
    for speed, front in ((25.0, 15.0), (30.0, 30.0), (12.0, 3.0)):
        safe = 50.0 - rss_longitudinal(following(50.0, speed, front)).item()
        rear_speed = np.where(TIME < 1.0, speed + 3.5 * TIME, speed + 3.5 - 4.0 * (TIME - 1.0))
        rear, ahead = (np.clip(each, 0.0, None).sum() * 2e-3 for each in (rear_speed, front - 8.0 * TIME))
        assert safe + ahead - rear == pytest.approx(0.0, abs=0.1)
