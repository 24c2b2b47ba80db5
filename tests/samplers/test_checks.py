"""Checks of arguments and outcomes."""

import math

import numpy as np
import pytest

from samplers.validation import (
    EvaluationError,
    check_choice,
    check_count,
    check_name,
    check_whole,
    describe_point,
    is_number,
    one_per_row,
)


@pytest.mark.parametrize("value", [0, 1.5, -math.inf, math.nan, np.float32(2), np.int8(3), 10**308])
def test_numbers(value):
    assert is_number(value)


@pytest.mark.parametrize("value", [True, np.bool_(True), "1", None, 1j, [1.0], np.array([1.0]), 10**400])
def test_what_is_no_number(value):
    assert not is_number(value)


def test_counts_and_whole_numbers_name_the_least():
    check_whole("n", 2, 2)
    check_count("M", "n", 2, 2)
    with pytest.raises(ValueError, match="Expected n to be a whole number of at least 2, got 1"):
        check_whole("n", 1, 2)
    with pytest.raises(ValueError, match="M: expected n to be a whole number of at least 2, got 1"):
        check_count("M", "n", 1, 2)


def test_an_unknown_name_comes_with_the_nearest_valid_one():
    check_name("method", "mc", ["mc", "adss"])
    with pytest.raises(ValueError, match=r"^Unknown method 'ads'. Did you mean 'adss'\? Valid: mc, adss.$"):
        check_name("method", "ads", ["mc", "adss"])
    with pytest.raises(ValueError, match=r"^Unknown method 3. Valid: mc, adss.$"):
        check_name("method", 3, ["mc", "adss"])


def test_choices_are_listed():
    check_choice("M", "kind", "a", ("a", "b"))
    with pytest.raises(ValueError, match='M: expected kind "a" or "b", got 1'):
        check_choice("M", "kind", 1, ("a", "b"))


F = np.arange(5.0)


@pytest.mark.parametrize("values", [[0, 1, 2, 3, 4], range(5), F.astype(np.float32), F.astype(int)])
def test_numbers_of_any_kind_become_float64(values):
    f = one_per_row(values, 5)
    assert f.dtype == np.float64
    np.testing.assert_array_equal(f, F)


@pytest.mark.parametrize("values", [np.eye(5), F[:-1], 1.0, F[:, None], [], ["a"] * 5, [None, [1]], None, 1j * F])
def test_anything_else_is_refused_with_the_shape_expected(values):
    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(5,\), one"):
        one_per_row(values, 5)


def test_a_point_is_described_by_its_first_and_last_coordinates():
    assert describe_point(np.arange(20.0, 40.0)) == "[20., 21., 22., ..., 37., 38., 39.]"
