"""Isolation of failing rows: which are found, by how many attempts."""

import pytest

from rare_envs.egos.errors import EgoGone, NoAnswer
from rare_envs.egos.isolation import attempt_in_parts, part_size

NO_ROAD = RuntimeError("no road")


def isolate(n, bad, error=NO_ROAD, first=None):
    """Return values, reasons and the sizes of the attempts at n rows of which some raise."""
    sizes = []

    def attempt(rows):
        sizes.append(len(rows))
        if bad & set(rows):
            raise error
        return [10 * row for row in rows], {}

    found = attempt_in_parts(attempt, lambda row: [-row], range(n), first)
    assert found is not None
    return [value for part in found[0] for value in part], found[1], sizes


@pytest.mark.parametrize("bad", [set(), {0}, {6}, {2, 3}, set(range(7))])
@pytest.mark.parametrize("error", [RuntimeError("no road"), NoAnswer("no answer")])
def test_failing_rows_are_found_and_no_others(bad, error):
    values, reasons, _ = isolate(7, bad, error)
    assert values == [-row if row in bad else 10 * row for row in range(7)]
    assert set(reasons) == bad


def test_one_row_of_a_batch_is_found_by_halving():
    _, _, sizes = isolate(64, {0})
    assert sizes == [64, 32, 16, 8, 4, 2, 1, 1, 2, 4, 8, 16, 32]


def test_one_row_without_an_answer_is_found_by_two_more_waits():
    _, _, sizes = isolate(100, {0}, NoAnswer("no answer"))
    assert sizes == [100, 10, *[1] * 10, *[10] * 9]


def test_part_sizes():
    assert [part_size(n, RuntimeError(), 100) for n in (2, 3, 100)] == [1, 2, 50]
    assert [part_size(n, NoAnswer(), 100) for n in (100, 10, 2)] == [10, 1, 1]
    assert part_size(2, NoAnswer(), 2) == 1


def test_a_single_row_that_failed_is_tried_once_more_unless_it_did_not_answer():
    for error, attempts in ((RuntimeError("no road"), 1), (NoAnswer("no answer"), 0)):
        values, reasons, sizes = isolate(1, {0}, error, first=error)
        assert (values, list(reasons), len(sizes)) == ([0], [0], attempts)


def test_reasons_of_an_attempt_are_passed_on():
    found = attempt_in_parts(lambda rows: ("f", {3: "f is NaN"}), lambda row: "?", range(5))
    assert found == (["f"], {3: "f is NaN"})


def test_a_batch_that_cannot_be_split_is_given_up_at_once():
    sizes = []

    def attempt(rows):
        sizes.append(len(rows))
        return None

    assert attempt_in_parts(attempt, lambda row: 0, range(8), RuntimeError("no road")) is None
    assert sizes == [4]


def test_nobody_goes_on_without_an_ego():
    def attempt(rows):
        raise EgoGone("not there")

    with pytest.raises(EgoGone):
        attempt_in_parts(attempt, lambda row: 0, range(8))
