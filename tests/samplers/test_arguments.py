"""Arguments of a run are checked where they are given; a base whose map does not fit its draws is refused."""

import inspect
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers import testing
from samplers.problem import FloatArray, StandardNormal
from samplers.run import RunArguments


@pytest.mark.parametrize("door", [samplers.estimate, samplers.methods.Method.start])
def test_the_defaults_of_the_front_doors_are_these(door):
    defaults = {name: each.default for name, each in inspect.signature(door).parameters.items()}
    assert {each.name: defaults[each.name] for each in fields(RunArguments)} == vars(RunArguments())


class Exponential:
    """Independent exponential coordinates; the parts can be replaced by others that do not fit."""

    def __init__(self, dim: int = 2, **parts: Callable[..., Any]) -> None:
        self.dim, self.parts = dim, parts

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        return self._part("sample", lambda n, rng: rng.exponential(size=(n, self.dim)))(n, rng)

    def log_prob(self, x: FloatArray) -> FloatArray:
        return self._part("log_prob", lambda x: stats.expon.logpdf(x).sum(axis=1))(x)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        return self._part("to_standard_normal", lambda x: stats.norm.isf(stats.expon.sf(x)))(x)

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        return self._part("from_standard_normal", lambda u: stats.expon.isf(stats.norm.sf(u)))(u)

    def _part(self, name: str, usual: Callable[..., Any]) -> Callable[..., Any]:
        return self.parts.get(name, usual)


def correlated(n: int, rng: np.random.Generator) -> FloatArray:
    first = rng.standard_normal(n)
    both = np.column_stack([first, 0.8 * first + 0.6 * rng.standard_normal(n)])
    return np.asarray(stats.expon.isf(stats.norm.sf(both)))


WRONG: dict[str, tuple[dict[str, Callable[..., Any]], str]] = {
    "another scale": ({"sample": lambda n, rng: 3.0 * rng.exponential(size=(n, 2))}, "mean|standard deviation"),
    "another spread": (
        {"sample": lambda n, rng: stats.expon.isf(stats.norm.sf(1.5 * rng.standard_normal((n, 2))))},
        "standard deviation 1",
    ),
    "another shape": (
        {"sample": lambda n, rng: stats.expon.isf(stats.norm.sf(np.sign(rng.standard_normal((n, 2)))))},
        "Kolmogorov distance",
    ),
    "correlated": ({"sample": correlated}, r"correlation 0\.[78]\d? between coordinates 0 and 1"),
    "no inverse": ({"from_standard_normal": lambda u: stats.norm.cdf(u)}, "where x is"),
    "NaN": ({"to_standard_normal": lambda x: np.log(x - 1)}, "NaN or infinity"),
    "transposed": ({"sample": lambda n, rng: rng.exponential(size=(2, n))}, r"shape \(2, 200\)"),
    "infinite draws": ({"sample": lambda n, rng: np.full((n, 2), np.inf)}, "sample.* gave NaN or infinity"),
    "no density": ({"log_prob": lambda x: np.full(len(x), -np.inf)}, "200 finite numbers"),
    "a column too few": ({"to_standard_normal": lambda x: x[:, :1]}, r"shapes \(200, 1\)"),
}


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_refused_by_estimate_and_by_the_check(name: str) -> None:
    parts, words = WRONG[name]

    class Problem:
        dim, base = 2, Exponential(2, **parts)

        def evaluate(self, x: FloatArray) -> FloatArray:
            raise AssertionError("nothing is to be simulated")

    with pytest.raises(ValueError, match=rf"problem\.base.*({words})"):
        samplers.estimate(Problem(), seed=0, max_sim=1000)
    with pytest.raises(AssertionError, match=words):
        testing.check_base(Problem.base, 2)


def test_what_fits_is_not_refused() -> None:
    for dim in (1, 2, 40, 400):
        testing.check_base(Exponential(dim), dim)
        testing.check_base(StandardNormal(dim), dim)

    def missing(x: FloatArray) -> FloatArray:
        raise NotImplementedError  # as a base says that it has no map, which plain Monte Carlo does not need

    testing.check_base(Exponential(2, to_standard_normal=missing), 2)
