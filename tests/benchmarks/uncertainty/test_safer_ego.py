"""An IDM with a longer headway is safer in the base and in its refits, and the ratio spreads less than p."""

import math

from benchmarks.uncertainty.safer_ego import list_fitted_bases, measure_base


def test_the_bases_are_those_with_refits():
    found = set(list_fitted_bases())
    assert {("cut_in", "us101"), ("car_following", "us101-gap"), ("hard_brake", "us101")} <= found
    assert ("cut_in", "highway") not in found


def test_a_longer_headway_is_safer_in_a_base_and_in_its_refits():
    row = measure_base("cut_in", "i80", max_sim=3000)
    assert row.ratio > 1.0
    assert row.covered_refits > row.refits / 2
    assert row.safer_refits == row.covered_refits
    assert row.ratio_spread < min(row.spreads)
    assert math.log(row.ratio_interval[1] / row.ratio_interval[0]) < math.log(row.p_interval[1] / row.p_interval[0])
