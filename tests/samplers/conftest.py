"""Shared by the sampler tests: a generator, counting functions, a study over seeds."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy import stats

import samplers
from samplers.method import Interrupted


class Recorder:
    """Wraps f and keeps its own books, independent of the package's counter."""

    def __init__(self, f):
        self.f = f
        self.batches = []

    def __call__(self, x):
        self.batches.append(np.array(x))
        return self.f(x)

    @property
    def rows(self) -> int:
        return sum(len(batch) for batch in self.batches)

    @property
    def points(self):
        return np.concatenate(self.batches)


@dataclass
class Study:
    """Many runs on one problem with exact p."""

    p: float
    results: list

    @property
    def ratios(self):
        return np.array([result.p for result in self.results]) / self.p

    @property
    def covered(self) -> int:
        return sum(r.interval[0] <= self.p <= r.interval[1] for r in self.results)

    @property
    def error(self) -> float:
        """The standard error of the mean ratio."""
        return float(self.ratios.std(ddof=1) / np.sqrt(len(self.results)))

    @property
    def own_cov(self) -> float:
        """The median of the finite c.o.v.: a run without a failure has none, and would make a mean infinite."""
        return float(np.median([result.cov for result in self.results if np.isfinite(result.cov)]))

    @property
    def spread(self) -> float:
        """The standard deviation of the ratios of the runs with a finite c.o.v., which `own_cov` describes."""
        return float(self.ratios[[bool(np.isfinite(result.cov)) for result in self.results]].std(ddof=1))

    def check(self, bias: float = 0.0, confidence: float = 0.90) -> None:
        """Check mean (within four standard errors and a bias) and coverage (by chance lower in 1 of 1,000 studies)."""
        assert abs(self.ratios.mean() - 1) < 4 * self.error + bias
        assert self.covered >= stats.binom.ppf(1e-3, len(self.results), confidence)


class Driven(NamedTuple):
    """What steps returned, and all outcomes that they were sent."""

    value: Any
    f: np.ndarray


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240917)


@pytest.fixture
def recorder() -> type[Recorder]:
    return Recorder


@pytest.fixture
def drive() -> Callable[..., Driven]:
    def run(steps, problem, interrupt_at=None) -> Driven:
        """Answer the points that steps yield; interrupt in place of the batch of that number, counted from 0."""
        f = []
        try:
            x = next(steps)
            while len(f) != interrupt_at:
                f.append(problem.evaluate(x))
                x = steps.send(f[-1])
            steps.throw(Interrupted())
        except StopIteration as end:
            return Driven(end.value, np.concatenate([np.empty(0), *f]))
        raise AssertionError("expected an outcome after an interruption")

    return run


@pytest.fixture
def study() -> Callable[..., Study]:
    def run(reference, method, runs, **options) -> Study:
        results = [samplers.estimate(reference.problem, method, seed=seed, **options) for seed in range(runs)]
        return Study(reference.p, results)

    return run
