"""Intervals over families of refits, by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from samplers.analysis.refits import (
    RefitFamily,
    expect_over_families,
    find_log_ends,
    read_refit_families,
    refit_quantile,
    split_families,
)

OWN = np.array([-1.0, 0.0, 1.0] * 20)
"""60 refits around 0, variance 40 / 59."""


T = {4: 2.776445, 11: 2.200985, 59: 2.000995, 64: 1.997730}
"""97.5 % points of Student's t from a table."""


def ends_of(log_p, values, family_of, other_variance=0.0, clusters=1000):
    return find_log_ends(split_families(log_p, values, family_of), other_variance, 0.95, clusters)


def test_one_family_has_the_interval_around_p_itself():
    half = T[59] * np.sqrt(40 / 59 + 0.04)
    assert ends_of(0.3, OWN, np.zeros(60, dtype=int), 0.04) == pytest.approx((0.3 - half, 0.3 + half))


@pytest.mark.parametrize(("shift", "end"), [(-8.0, 0), (8.0, 1)])
def test_another_family_moves_the_end_on_its_side_alone(shift, end):
    """12 refits of its own around its mean: variance 8 / 11, and 11 degrees of freedom."""
    values = np.concatenate([OWN, shift + OWN[:12]])
    wanted = np.array([-1.0, 1.0]) * T[59] * np.sqrt(40 / 59)
    wanted[end] = shift + np.sign(shift) * T[11] * np.sqrt(8 / 11)
    assert ends_of(0.0, values, np.repeat([0, 3], [60, 12])) == pytest.approx(tuple(wanted))


def test_a_family_of_few_refits_takes_the_pooled_spread_and_one_of_hardly_any_none():
    values = np.concatenate([OWN, 5.0 + OWN[:6], [90.0]])
    family_of = np.repeat([0, 1, 2], [60, 6, 1])
    pooled = (40 + 4) / (67 - 3)
    low, high = ends_of(0.0, values, family_of)
    assert low == pytest.approx(-T[59] * np.sqrt(40 / 59))
    assert high == pytest.approx(5.0 + T[64] * np.sqrt(pooled))


def test_p_itself_counts_where_no_refit_is_of_its_family():
    values, family_of = OWN - 9.0, np.ones(60, dtype=int)
    half = T[59] * np.sqrt(40 / 59)
    assert ends_of(0.0, values, family_of) == pytest.approx((-9.0 - half, half))
    assert [each.share for each in split_families(0.0, values, family_of)] == [0.0, 1.0]


def test_families_of_one_refit_each_are_taken_for_one():
    (family,) = split_families(0.0, np.array([-1.0, 1.0]), np.array([0, 1]))
    assert family == (0.0, pytest.approx(2.0), 1, 1.0)


@pytest.mark.parametrize(
    ("freedom", "clusters", "confidence", "quantile"),
    [(29, 100, 0.95, 2.045230), (29, 17, 0.95, 2.119905), (99, 17, 0.9, 1.745884), (1, 28, 0.95, 12.706205)],
)
def test_quantiles_of_t_from_a_table(freedom, clusters, confidence, quantile):
    assert refit_quantile(confidence, freedom, clusters) == pytest.approx(quantile, rel=1e-6)
    family = RefitFamily(0.0, 1.2**2, freedom, 1.0)
    half = quantile * np.sqrt(2.25)
    assert find_log_ends((family,), 0.81, confidence, clusters) == pytest.approx((-half, half), rel=1e-6)


def test_clusters_of_events_limit_the_degrees_of_freedom_of_each_family():
    values, family_of = np.concatenate([OWN, OWN[:12] - 8.0]), np.repeat([0, 1], [60, 12])
    low, high = ends_of(0.0, values, family_of, clusters=5)
    assert (low, high) == pytest.approx((-8.0 - T[4] * np.sqrt(8 / 11), T[4] * np.sqrt(40 / 59)))


def test_what_two_families_expect_by_hand():
    """60 refits around log 0.01 and 30 around log 1e-5, of variances 40 / 59 and 20 / 29.

    2 / 3 of 0.01 exp(20 / 59) = 0.014035 and 1 / 3 of 1e-5 exp(10 / 29) = 1.412e-5. The spread over all, 3.4, would
    have made exp(5.7) = 290 times p of it.
    """
    values = np.concatenate([np.log(0.01) + OWN, np.log(1e-5) + OWN[:30]])
    assert values.std(ddof=1) == pytest.approx(3.38, abs=0.01)
    families = split_families(np.log(0.01), values, np.repeat([0, 1], [60, 30]))
    assert expect_over_families(families) == pytest.approx(0.014035 * 2 / 3 + 1.412e-5 / 3, rel=1e-3)


def test_no_family_expects_more_than_the_largest_value_possible():
    families = RefitFamily(np.log(0.5), 8.0, 29, 0.25), RefitFamily(np.log(1e-6), 0.0, 29, 0.75)
    assert expect_over_families(families) == pytest.approx(0.25 + 0.75e-6)
    assert expect_over_families(families, largest=3.0) == pytest.approx(0.25 * 3.0 + 0.75e-6)
    assert expect_over_families(families, largest=50.0) == pytest.approx(0.25 * 0.5 * np.exp(4.0) + 0.75e-6)


def test_a_base_may_know_no_families_and_must_know_all():
    assert read_refit_families(object(), 3).tolist() == [0, 0, 0]
    assert read_refit_families(SimpleNamespace(refit_families=(0, 1, 1)), 3).tolist() == [0, 1, 1]
    with pytest.raises(ValueError, match="one family for each of 3 refits"):
        read_refit_families(SimpleNamespace(refit_families=(0, 1)), 3)
