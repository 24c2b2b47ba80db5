"""Exposure: time under, and area under, a critical time to collision."""

import pytest

from tests.rare_envs.measures.moments import AWAY, CLOSE, HIT, f


def test_time_exposed_and_integrated() -> None:
    # at 0.1 k s the TTC is 10.05 - 0.1 k: below 3 s from k = 71 to k = 100
    assert f("tet", *CLOSE) == pytest.approx(1.0 - 3.0, abs=1e-4)
    assert f("tit", *CLOSE) == pytest.approx(1.0 - 0.1 * sum(3.0 - (10.05 - 0.1 * k) for k in range(71, 101)), abs=1e-3)
    assert f("tet", *AWAY) == f("tit", *AWAY) == 1.0
    assert f("tet", *HIT) == f("tit", *HIT) == -1000.0
