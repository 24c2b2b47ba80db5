"""Estimates under other base distributions, with exact p."""

import contextlib
import functools
import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import openturns
import pytest
from scipy import stats
from scipy.special import ndtr

import samplers
from samplers.limit_states import half_space

BETA = 3.0


@dataclass
class Normal:
    """N(shift towards the failures, sd^2 I)."""

    shift: float
    dim: int = 2
    sd: float = 1.0

    @property
    def mean(self):
        return np.full(self.dim, self.shift / math.sqrt(self.dim))

    def log_prob(self, x):
        return stats.norm.logpdf(x, self.mean, self.sd).sum(axis=1)

    def sample(self, n, rng):
        return self.mean + self.sd * rng.standard_normal((n, self.dim))

    @property
    def p(self):
        return float(ndtr((self.shift - BETA) / self.sd))


def only_density(distribution):
    return SimpleNamespace(log_prob=distribution.log_prob)


@functools.cache
def run(method="ce", seed=1, **options):
    return samplers.estimate(half_space(2, BETA).problem, method, seed=seed, **options)


def test_of_plain_draws_the_spread_is_that_of_the_ratios():
    """The variance of a mean of ratios, 0 where f > gamma, and the largest of them once more."""
    result, new = run("mc", max_sim=60_000), Normal(0.3)
    x = result.sample.x
    ratios = np.exp(new.log_prob(x) - Normal(0.0).log_prob(x))
    terms = np.concatenate([ratios, np.zeros(60_000 - len(x))])
    answer = result.reweight(new)
    assert answer.p == pytest.approx(terms.mean())
    variance = terms.var() / 60_000 + (terms.max() / 60_000) ** 2
    assert answer.cov == pytest.approx(np.sqrt(variance) / terms.mean())


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_the_same_base_gives_the_same_p(method):
    result = run(method)
    again = result.reweight(samplers.distributions.StandardNormal(2))
    assert again.p == pytest.approx(result.p)
    assert again.ratio == pytest.approx(1)
    # Reweighting takes draws as independent; those of two-stage are stratified, and spread less.
    most = 3.0 if method in ("two-stage", "auto") else 1.4
    assert 0.99 * result.cov < again.cov < most * result.cov
    assert again.interval[0] < 1.05 * result.interval[0]
    assert again.interval[1] > 0.95 * result.interval[1]
    assert again.ess >= again.units * 0.99


CHANGES = [Normal(1.0), Normal(-0.5), Normal(0.0, sd=1.2)]


def judge(method, base, runs, **options):
    found = []
    for seed in range(runs):
        with contextlib.suppress(ValueError):  # subset simulation with hardly any paths
            found.append(run(method, seed, **options).reweight(base))
    kept = len(found)
    assert kept >= 0.75 * runs
    ratios = np.array([one.p for one in found]) / base.p
    assert abs(ratios.mean() - 1) < 4 * ratios.std(ddof=1) / math.sqrt(kept) + 0.05
    assert 0.6 < np.mean([one.cov for one in found]) / ratios.std(ddof=1) < 1.6
    return sum(one.interval[0] <= base.p <= one.interval[1] for one in found) / kept


@pytest.mark.parametrize("base", CHANGES, ids=str)
@pytest.mark.parametrize("method", ["mc", "ce", "ss", "adss"])
def test_changed_bases_with_exact_p(method, base):
    runs = 20
    options = {"max_sim": 40_000} if method == "mc" else {}
    assert judge(method, base, runs, **options) >= stats.binom.ppf(1e-3, runs, 0.9) / runs


def test_subset_simulation_counts_paths_not_points():
    result = run("adss")
    found = result.reweight(Normal(0.5))
    assert found.units < 40 < 60 < found.ess
    assert found.cov > 1 / math.sqrt(found.ess)
    more = run("adss", replicates=5).reweight(Normal(0.5))
    assert more.units > 2 * found.units


@pytest.mark.parametrize("method", ["mc", "ce", "adss"])
def test_a_base_too_far_away_is_refused(method):
    with pytest.raises(ValueError, match=r"effective sample size of .*, from .* at least 30 and 5 .* Estimate again"):
        run(method).reweight(Normal(7.0, sd=0.3))


@dataclass
class Uniform:
    low: float
    high: float

    def log_prob(self, x):
        inside = ((x >= self.low) & (x <= self.high)).all(axis=1)
        return np.where(inside, -2 * math.log(self.high - self.low), -np.inf)

    def sample(self, n, rng):
        return rng.uniform(self.low, self.high, (n, 2))

    def to_standard_normal(self, x):
        return stats.norm.ppf((x - self.low) / (self.high - self.low))

    def from_standard_normal(self, u):
        return self.low + (self.high - self.low) * ndtr(u)


class InBox:
    """P[x1 + x2 >= 1.9] in the unit square: 0.005."""

    dim, base = 2, Uniform(0.0, 1.0)

    def evaluate(self, x):
        return 1.9 - x.sum(axis=1)


def test_a_base_that_reaches_beyond_the_old_support_is_refused():
    result = samplers.estimate(InBox(), "ce", seed=1)
    with pytest.raises(ValueError, match=r"no density at .* % of draws"):
        result.reweight(Uniform(0.0, 1.1))
    inner = result.reweight(Uniform(0.1, 1.0))
    assert inner.p == pytest.approx(0.005 / 0.81, rel=0.1)
    assert result.reweight(only_density(Uniform(0.0, 1.1))).p == pytest.approx(0.005 / 1.21, rel=0.1)  # nobody can tell


class WrongDraws(Normal):
    def sample(self, n, rng):
        return rng.standard_normal((n, 3))


@pytest.mark.parametrize(
    ("base", "text"),
    [
        ("highway", "knows no others by name"),
        (Normal(0.0, dim=3), "in 2 dimensions, got one in 3"),
        (WrongDraws(0.0), "in 2 dimensions; 10000 draws"),
        (only_density(Normal(0.0, dim=3)), "broadcast"),
        (SimpleNamespace(log_prob=lambda x: np.full(len(x), np.nan)), "log_prob is nan"),
        (SimpleNamespace(log_prob=lambda x: np.full(len(x), np.inf)), "log_prob is inf"),
        (SimpleNamespace(log_prob=lambda x: x), "one number per point"),
    ],
)
def test_a_base_that_does_not_fit_is_refused(base, text):
    with pytest.raises(ValueError, match=text):
        run().reweight(base)


def test_distributions_of_scipy_and_openturns_are_taken_as_bases_are():
    result = run()
    expected = result.reweight(SimpleNamespace(log_prob=stats.multivariate_normal([0.3, 0.1]).logpdf))
    for new in (
        stats.multivariate_normal([0.3, 0.1]),
        [stats.norm(0.3), stats.norm(0.1)],
        openturns.JointDistribution([openturns.Normal(0.3, 1.0), openturns.Normal(0.1, 1.0)]),
    ):
        assert result.reweight(new).p == pytest.approx(expected.p, rel=1e-9)
        assert result.reweight(new).cov == pytest.approx(expected.cov, rel=1e-9)
    with pytest.raises(ValueError, match="Expected a base distribution of 2 dimensions, got 3"):
        result.reweight([stats.norm(0.3)] * 3)


def test_without_failures_or_points_there_is_nothing_to_weigh():
    safe = samplers.estimate(half_space(2, 7.0).problem, "mc", seed=1, max_sim=100)
    for result, text in (
        (safe, r"^No point failed \(f <= 0\): there is nothing to (analyse|reweight)\.$"),
        (replace(run(), sample=None), "gave no weighted points"),
        (replace(run(), base=None), "does not know its base"),
    ):
        for analyse in (result.sensitivity, lambda result=result: result.reweight(Normal(0.0))):
            with pytest.raises(ValueError, match=text):
                analyse()
