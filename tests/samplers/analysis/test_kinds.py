"""Shares of p by kind of failure, and the weights of failures."""

import functools

import numpy as np
import pytest
from scipy.special import ndtr

import samplers

# failure beyond 2.5 along one axis ("east") or beyond 3 along the other ("north")
EAST, NORTH = float(ndtr(-2.5)), float(ndtr(-3.0) * ndtr(2.5))


def f(x):
    return np.minimum(2.5 - x[:, 0], 3.0 - x[:, 1])


def side(x):
    return ["east" if point[0] >= 2.5 else "north" for point in x]


@functools.cache
def run(method, seed=1, **options):
    return samplers.estimate(samplers.FunctionProblem(f, 2), method, seed=seed, **options)


@pytest.mark.parametrize("method", ["adss", "ce", "mc", "two-stage"])
def test_shares_add_up_to_p(method):
    result = run(method, max_sim=8_000)
    shares = result.shares(side)
    assert sum(share.p for share in shares.values()) == pytest.approx(result.p, rel=1e-12)
    assert sum(share.of_failures for share in shares.values()) == pytest.approx(1.0)
    assert all(share.interval[0] < share.p < share.interval[1] for share in shares.values())
    assert [share.p for share in shares.values()] == sorted((share.p for share in shares.values()), reverse=True)
    whole = result.shares(lambda x: ["any"] * len(x))["any"]
    assert whole.p == pytest.approx(result.p, rel=1e-12)
    assert whole.points == int((result.sample.f <= 0).sum())
    assert (whole.interval, whole.cov) == (result.interval, result.cov)


def test_shares_are_the_probabilities_of_the_kinds():
    result = run("two-stage", target_cov=0.05)
    shares = result.shares(side)
    for kind, p in (("east", EAST), ("north", NORTH)):
        found, (low, high) = shares[kind].p, shares[kind].interval
        assert found * (low / found) ** 2 < p < found * (high / found) ** 2  # four standard errors of the logarithm
    assert shares["north"].interval[1] < 3 * shares["north"].p  # that says something


def test_of_plain_draws_the_interval_is_binomial():
    result = run("mc", max_sim=20_000)
    share = result.shares(side)["north"]
    assert share.p == pytest.approx(share.points / 20_000)
    assert share.interval == pytest.approx(samplers.sample.clopper_pearson(share.points, 20_000, 0.95))


def test_some_of_the_points_speak_for_all():
    result = run("mc", max_sim=60_000)
    asked = []

    def count(x):
        asked.append(len(x))
        return side(x)

    some, every = result.shares(count, most=200), result.shares(side)
    assert asked == [200]
    assert sum(share.p for share in some.values()) == pytest.approx(result.p, rel=1e-12)
    assert some["north"].p == pytest.approx(every["north"].p, rel=0.3)
    low, high = some["north"].interval
    assert high - low > every["north"].interval[1] - every["north"].interval[0]  # 200 points say less


def test_points_without_an_outcome_are_a_kind_of_their_own():
    def broken(x):
        if (x[:, 0] > 3.0).any():
            raise RuntimeError
        return f(x)

    problem = samplers.FunctionProblem(broken, 2)
    result = samplers.estimate(problem, "mc", max_sim=5_000, seed=0, on_error="failure")
    shares = result.shares(side)
    assert shares["no outcome"].points == int(np.isneginf(result.sample.f).sum()) > 0
    assert sum(share.p for share in shares.values()) == pytest.approx(result.p)


def test_nothing_failed_no_shares_and_labels_that_are_no_words_are_refused():
    problem = samplers.FunctionProblem(lambda x: np.ones(len(x)), 2)
    assert samplers.estimate(problem, "mc", max_sim=100, seed=0).shares(side) == {}
    for label in (lambda x: ["east"], lambda x: range(len(x))):
        with pytest.raises(ValueError, match="Expected a word for each"):
            run("mc", max_sim=30_000).shares(label)
