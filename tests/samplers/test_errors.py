import numpy as np
import pytest

from samplers.errors import EvaluationError, FinalError, describe_row, one_per_row

F = np.arange(5.0)


@pytest.mark.parametrize("values", [[0, 1, 2, 3, 4], range(5), F.astype(np.float32), F.astype(int)])
def test_numbers_of_any_kind_become_float64(values):
    f = one_per_row(values, 5)
    assert f.dtype == np.float64
    np.testing.assert_array_equal(f, F)


def test_missing_and_infinite_values_are_numbers():
    np.testing.assert_array_equal(one_per_row([np.nan, np.inf, -np.inf], 3), [np.nan, np.inf, -np.inf])


@pytest.mark.parametrize("values", [np.eye(5), F[:-1], 1.0, F[:, None], [], ["a"] * 5, [None, [1]], None, 1j * F])
def test_anything_else_is_refused_with_the_shape_expected(values):
    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(5,\), one"):
        one_per_row(values, 5)


def test_a_row_is_described_by_its_number_and_its_first_and_last_coordinates():
    x = np.arange(40.0).reshape(2, 20)
    assert describe_row(x, 1) == "row 1 of a batch of 2, x = [20., 21., 22., ..., 37., 38., 39.]"


def test_calling_f_again_does_not_help_against_an_evaluation_error():
    assert isinstance(EvaluationError(), FinalError)
    assert EvaluationError().final
    assert not isinstance(ValueError(), FinalError)
