"""What a problem offers is known by what it has, whoever wrote it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

import samplers
from samplers.problem import FloatArray, Terms, condition_of, names_of_columns, offers_terms


@dataclass
class OwnProblem:
    """A user's problem, of no class of the package."""

    dim: int = 2
    base: samplers.StandardNormal = field(default_factory=lambda: samplers.StandardNormal(2))

    def evaluate(self, x: FloatArray) -> FloatArray:
        return np.asarray(x[:, 0])


class WithTerms(OwnProblem):
    def terms(self, x: FloatArray, gamma: float = 0.0) -> Terms:
        return Terms(x.min(axis=1), x, np.zeros(x.shape, dtype=np.int64), gamma)


class WithWords(OwnProblem):
    given = "drivers=idm"
    column_names = ("speed", "gap")


def test_an_own_problem_is_one_and_offers_what_it_has() -> None:
    assert isinstance(OwnProblem(), samplers.Problem)
    assert isinstance(samplers.StandardNormal(2), samplers.Distribution)
    assert [offers_terms(problem) for problem in (OwnProblem(), WithTerms())] == [False, True]
    assert [condition_of(problem) for problem in (OwnProblem(), WithWords())] == ["", "drivers=idm"]
    assert [names_of_columns(problem) for problem in (OwnProblem(), WithWords())] == [(), ("speed", "gap")]


@pytest.mark.parametrize("names", [("speed",), ("gap", "gap"), ("gap", 1)])
def test_names_of_columns_are_one_for_each(names: tuple[object, ...]) -> None:
    problem = WithWords()
    problem.column_names = names  # type: ignore[assignment]
    with pytest.raises(ValueError, match="2 different names, got"):
        names_of_columns(problem)


def test_the_least_term_and_the_lowest_value_are_those_of_each_row() -> None:
    x = np.array([[2.0, -1.0], [0.5, 3.0]])
    terms = WithTerms().terms(x)
    np.testing.assert_array_equal(terms.least, [1, 0])
    np.testing.assert_array_equal(terms.lowest, [-1.0, 0.5])
