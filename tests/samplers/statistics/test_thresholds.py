import numpy as np

from samplers.statistics import next_level


def test_distinct_outcomes_give_the_quantile_with_its_true_share(rng):
    f = rng.permutation(np.arange(1, 1001)) / 10
    assert next_level(f, 0.1, -1.0) == 10.0
    assert np.count_nonzero(f <= 10.0) == 100


def test_gamma_as_soon_as_enough_points_fail():
    f = np.arange(100.0)
    assert next_level(f, 0.1, 9.0) == 9.0  # ten points, exactly the fraction
    assert next_level(f, 0.1, 50.0) == 50.0
    assert next_level(f, 0.1, 8.0) == 9.0


def test_ties_at_a_cap_give_the_largest_value_below():
    f = np.concatenate([np.full(930, 10.0), np.linspace(1, 9, 70)])
    assert next_level(f, 0.1, 0.0) == 9.0
    assert next_level(np.array([10.0] * 95 + [-1.0] * 5), 0.1, 0.0) == 0.0  # never past gamma


def test_the_share_nearer_to_the_fraction_is_taken():
    f = np.array([1.0] * 2 + [2.0] * 13 + [3.0] * 85)
    assert next_level(f, 0.1, 0.0) == 2.0  # 15 % rather than 2 %
    f = np.array([1.0] * 8 + [2.0] * 30 + [3.0] * 62)
    assert next_level(f, 0.1, 0.0) == 1.0  # 8 % rather than 38 %


def test_no_way_on_where_all_or_most_outcomes_tie():
    assert next_level(np.full(100, 10.0), 0.1, 0.0) is None
    assert next_level(np.array([10.0] * 80 + [20.0] * 20), 0.1, 0.0) is None
    assert next_level(np.full(100, np.inf), 0.1, 0.0) is None


def test_infinite_outcomes_are_far_from_failure():
    f = np.array([np.inf] * 90 + list(range(1, 11)), dtype=float)
    assert next_level(f, 0.05, 0.0) == 5.0
