import numpy as np
import pytest

from samplers.errors import EvaluationError
from samplers.execution.fault_isolation import FaultIsolation, isolate_failing_rows

X = np.array([[1.0, 0.0], [3.0, 0.0], [2.0, 7.5], [4.0, 0.0], [-1.0, 0.0]])


def raises_at_two(x):
    if (x[:, 0] == 2).any():
        raise RuntimeError("no such road")
    return x[:, 0]


def test_f_cannot_change_the_callers_points():
    def careless(x):
        x[:] = 99.0
        return x[:, 0]

    x = np.ones((2, 2))
    FaultIsolation(careless).evaluate(x)
    np.testing.assert_array_equal(x, 1.0)


def test_an_f_that_writes_and_raises_does_not_spoil_the_halves():
    def careless(x):
        f = x[:, 0].copy()
        x[:] = 99.0
        if (f == 2).any():
            raise RuntimeError("no such road")
        return f

    f = FaultIsolation(careless, "failure").evaluate(X)
    np.testing.assert_array_equal(f, [1.0, 3.0, np.nan, 4.0, -1.0])


@pytest.mark.parametrize("on_error", ["failure", "bound"])
@pytest.mark.parametrize("wrong", [lambda x: x, lambda x: x[:-1, 0], lambda x: 1.0, lambda x: x[:, :1], lambda x: None])
def test_parts_of_the_wrong_shape_are_an_error(wrong, on_error):
    """Put together, they might have the right one."""

    def f(x):
        if len(x) == 4:
            raise RuntimeError("no such road")
        return wrong(x)

    with pytest.raises(EvaluationError, match=r"Expected f to return shape \(2,\)"):
        FaultIsolation(f, on_error).evaluate(np.ones((4, 2)))


def test_isolation_takes_two_calls_for_each_halving():
    """One failing row of 64: 64 -> 32 -> ... -> 1 are six halvings, and both halves are called at each."""
    calls = []

    def f(x):
        calls.append(len(x))
        if (x[:, 0] == 20).any():
            raise RuntimeError("no such road")
        return x[:, 0]

    values, n_retried = isolate_failing_rows(f, np.arange(64.0)[:, None])
    assert sorted(calls) == sorted(2 * [32, 16, 8, 4, 2, 1])
    assert n_retried == sum(calls)
    assert np.flatnonzero(np.isnan(values)).tolist() == [20]


def test_raise_names_row_and_x_and_keeps_the_cause():
    expected = r"row 2 of a batch of 5, x = \[2\. , 7\.5\]; RuntimeError: no such road"
    with pytest.raises(EvaluationError, match=expected) as caught:
        FaultIsolation(raises_at_two).evaluate(X)
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_raise_quotes_what_f_says_of_the_row_it_names():
    """f names one bad row of its batch, and not the first."""

    def f(x):
        bad = np.flatnonzero(x[:, 0] >= 2)
        if len(bad):
            raise RuntimeError(f"no road at {x[bad[-1], 0]:g}")
        return x[:, 0]

    with pytest.raises(EvaluationError, match=r"row 1 of a batch of 5, x = .*; RuntimeError: no road at 3$") as caught:
        FaultIsolation(f).evaluate(X)
    assert str(caught.value.__cause__) == "no road at 3"


def test_an_error_that_does_not_repeat_is_said_to():
    calls = []

    def once(x):
        calls.append(1)
        if len(calls) == 1:
            raise OSError("socket closed")
        return x[:, 0]

    with pytest.raises(EvaluationError, match="not repeatably; OSError: socket closed"):
        FaultIsolation(once).evaluate(X)


@pytest.mark.parametrize("on_error", ["failure", "bound"])
def test_rows_that_raise_get_nan_and_rows_handed_over_again_are_counted(on_error):
    guarded = FaultIsolation(raises_at_two, on_error)
    np.testing.assert_array_equal(guarded.evaluate(X), [1.0, 3.0, np.nan, 4.0, -1.0])
    assert guarded.n_retried == 5 + 3  # 5 -> 3 + 2; 3 -> 2 + 1


@pytest.mark.parametrize("on_error", ["raise", "failure"])
def test_a_final_error_is_passed_on_at_once(on_error):
    class Gone(RuntimeError):
        final = True

    calls = []

    def f(x):
        calls.append(len(x))
        raise Gone("nobody is there")

    with pytest.raises(Gone, match="nobody is there"):
        FaultIsolation(f, on_error).evaluate(np.zeros((8, 2)))
    assert calls == [8]
