"""Figures of naturalistic studies against those printed in their sources or in the table of exposure."""

from __future__ import annotations

import pytest

from rare_envs.exposure import HUMAN_BENCHMARKS

TABLE = {
    ("100-Car", "contacts of all kinds"): (21, 16, 27, 1.6e-3),
    ("100-Car", "near-crashes"): (236, 220, 254, 1.8e-2),
    ("100-Car", "contacts into a vehicle ahead"): (4.3, 2.4, 7.3, 3.3e-4),
    ("100-Car", "near-crashes with a vehicle ahead"): (120, 108, 132, 9.0e-3),
    ("100-Car", "contacts begun by another's lane change"): (0.31, 0.01, 1.7, 2.3e-5),
    ("100-Car", "near-crashes begun by another's lane change"): (42, 36, 50, 3.2e-3),
    ("SHRP 2", "crashes without tyre strikes"): (15, None, None, None),
    ("SHRP 2", "severe crashes"): (4.5, None, None, None),
}
"""Per million km with its interval, and per hour."""


@pytest.mark.parametrize("benchmark", HUMAN_BENCHMARKS, ids=lambda each: f"{each.study} {each.kind}")
def test_rates(benchmark) -> None:
    rate, low, high, per_hour = TABLE[benchmark.study, benchmark.kind]
    assert benchmark.per_million_km == pytest.approx(rate, rel=0.03)
    if low is not None:
        assert benchmark.interval_per_million_km == pytest.approx((low, high), rel=0.03, abs=0.005)
    assert benchmark.per_hour == (None if per_hour is None else pytest.approx(per_hour, rel=0.03))
    assert benchmark.source
    assert benchmark.words
    assert benchmark.to_dict()["per_million_km"] == benchmark.per_million_km
