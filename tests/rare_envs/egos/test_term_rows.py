"""Terms as a table come back as they were, beside rows of which nothing is known."""

import numpy as np

from rare_envs.egos.term_rows import TermRows, join_tables, overwrite_rows, read_terms, tabulate_terms

RNG = np.random.default_rng(2)
TERMS = TermRows(RNG.random(5), RNG.random((5, 3)), RNG.integers(0, 90, (5, 3)), 0.25, ("a", "b", "c"))
LOST = np.full((1, 1), np.nan)


def test_what_was_tabulated_is_read() -> None:
    for found, expected in zip(read_terms(tabulate_terms(TERMS), 0.25, TERMS.names), TERMS, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_lost_rows_stand_where_they_stood() -> None:
    table = tabulate_terms(TERMS)
    found = read_terms(join_tables([table[:2], LOST, table[2:]]), 0.25, TERMS.names)
    np.testing.assert_array_equal(np.isnan(found.f), np.arange(6) == 2)
    np.testing.assert_array_equal(found.values[[0, 1, 3, 4, 5]], TERMS.values)
    assert np.isnan(found.values[2]).all() and found.ticks[2].tolist() == [0, 0, 0]


def test_rows_are_replaced_by_wider_ones() -> None:
    table = tabulate_terms(TERMS)
    found = overwrite_rows(join_tables([LOST, LOST]), np.array([1]), table[3:4])
    assert np.isnan(found[0]).all()
    np.testing.assert_array_equal(found[1], table[3])


def test_of_lost_rows_alone_one_unknown_term_is_left() -> None:
    found = read_terms(join_tables([LOST] * 3), 0.0, ("f",))
    assert found.values.shape == found.ticks.shape == (3, 1)
    assert np.isnan(found.values).all()
