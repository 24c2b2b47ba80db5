"""Intervals over families of refits, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from samplers.analysis.refit_groups import find_log_ends, read_groups

OWN = np.array([-1.0, 0.0, 1.0] * 20)
"""60 refits around 0, variance 40 / 59."""


def test_one_family_has_the_interval_around_p_itself():
    half = 2.0 * np.sqrt(40 / 59 + 0.04)
    ends = find_log_ends(0.3, OWN, np.zeros(60, dtype=int), other_variance=0.04, quantile=2.0)
    assert ends == pytest.approx((0.3 - half, 0.3 + half))


@pytest.mark.parametrize(("shift", "end"), [(-8.0, 0), (8.0, 1)])
def test_another_family_moves_the_end_on_its_side_alone(shift, end):
    """12 refits of its own around its mean: variance 8 / 11."""
    values = np.concatenate([OWN, shift + OWN[:12]])
    ends = find_log_ends(0.0, values, np.repeat([0, 3], [60, 12]), other_variance=0.0, quantile=2.0)
    wanted = np.array([-1.0, 1.0]) * 2.0 * np.sqrt(40 / 59)
    wanted[end] = shift + np.sign(shift) * 2.0 * np.sqrt(8 / 11)
    assert ends == pytest.approx(tuple(wanted))


def test_a_family_of_few_refits_takes_the_pooled_spread_and_one_of_hardly_any_none():
    values = np.concatenate([OWN, 5.0 + OWN[:6], [90.0]])
    groups = np.repeat([0, 1, 2], [60, 6, 1])
    pooled = (40 + 4) / (67 - 3)
    low, high = find_log_ends(0.0, values, groups, other_variance=0.0, quantile=2.0)
    assert low == pytest.approx(-2.0 * np.sqrt(40 / 59))
    assert high == pytest.approx(5.0 + 2.0 * np.sqrt(pooled))


def test_p_itself_counts_where_no_refit_is_of_its_family():
    low, high = find_log_ends(0.0, OWN - 9.0, np.ones(60, dtype=int), other_variance=0.0, quantile=2.0)
    assert (low, high) == pytest.approx((-9.0 - 2.0 * np.sqrt(40 / 59), 2.0 * np.sqrt(40 / 59)))


def test_families_of_one_refit_each_have_the_spread_of_all():
    ends = find_log_ends(0.0, np.array([-1.0, 1.0]), np.array([0, 1]), other_variance=0.0, quantile=1.0)
    assert ends == pytest.approx((-np.sqrt(2.0), 1.0 + np.sqrt(2.0)))


def test_a_base_may_know_no_groups_and_must_know_all():
    assert read_groups(object(), 3).tolist() == [0, 0, 0]
    assert read_groups(SimpleNamespace(refit_groups=(0, 1, 1)), 3).tolist() == [0, 1, 1]
    with pytest.raises(ValueError, match="one group for each of 3 refits"):
        read_groups(SimpleNamespace(refit_groups=(0, 1)), 3)
