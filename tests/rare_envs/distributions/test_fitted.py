"""Fitted distributions: frequency, counts in words, refits and their mixture, files that come back or are damaged."""

import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.events import EventCounts, EventFrequency, PredictiveCheck, read_record
from rare_envs.distributions.fitted import FittedDistribution, join_independent
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.product import NoiseDistribution, ProductDistribution

NAMES = ["speed", "lead_speed", "gap"]
ORDER = ["speed", "gap", "lead_speed"]
COORDINATES: list[Any] = ["plain", {"closing_behind": "speed", "gap": "gap"}, "log"]
COUNTS = EventCounts(used=(38, 15), clusters=17)
CUT_INS = EventFrequency(
    count=1221,
    hours=112.0,
    km=3900.0,
    share=38 / 46,
    share_events=46,
    definition="lane changes ahead of a vehicle",
    source="NGSIM US 101, complete",
)


def components(seed: int, k: int) -> dict[str, Any]:
    rng = np.random.default_rng(seed)
    scale = np.array([3.0, 0.5, 0.3])
    roots = 0.3 * rng.standard_normal((k, 3, 3)) + np.eye(3)
    return {
        "weights": rng.dirichlet(np.full(k, 5.0)).tolist(),
        "means": (np.array([14.0, 2.7, 0.0]) + scale * rng.uniform(-1, 1, (k, 3))).tolist(),
        "covariances": (roots @ roots.transpose(0, 2, 1) * np.outer(scale, scale)).tolist(),
    }


CONTENT: dict[str, Any] = {
    **components(0, 2),
    "names": NAMES,
    "order": ORDER,
    "coordinates": COORDINATES,
    "low": [0.0, 0.0, 1.0],
    "high": [45.0, 45.0, 150.0],
    "family": "2 components, closing speed / sqrt(gap), log gap",
    "events": {"used": [38, 15], "clusters": 17, "cluster": "scene"},
    "frequency": asdict(CUT_INS),
    "checks": [{"name": "TTC < 5 s", "recorded": 7, "expected": 15.9}],
    "provenance": {"site": "US 101", "bic": 7852.8},
    "refits": [components(seed, k) for seed, k in ((1, 1), (2, 2), (3, 3))],
}
BASE = FittedDistribution.from_dict(CONTENT)


def test_frequency_and_its_error_by_hand() -> None:
    """10.90 cut-ins per hour times 0.826; 1 / 1221 + 1 / 38 - 1 / 46 = 0.000819 + 0.026316 - 0.021739 = 0.005396."""
    assert (round(CUT_INS.per_hour, 2), round(CUT_INS.per_km, 3)) == (9.01, 0.259)
    assert CUT_INS.log_sd**2 == pytest.approx(1 / 1221 + 1 / 38 - 1 / 46, rel=1e-12)
    assert replace(CUT_INS, share_events=None).log_sd == pytest.approx(1221**-0.5, rel=1e-12)
    assert read_record(EventFrequency, "frequency", asdict(CUT_INS)) == CUT_INS


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "count of the frequency as a whole number, 1 or more, got 0"),
        ({"km": float("nan")}, "km of the frequency as a number above 0, got nan"),
        ({"share": 1.2}, "share of the frequency as a number above 0, at most 1, got 1.2"),
        ({"definition": ""}, "definition of the frequency as a text, got ''"),
    ],
)
def test_bad_frequencies_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CUT_INS, **change)


def test_what_it_was_fitted_to() -> None:
    assert (BASE.fitted_to, BASE.clusters) == ("38 + 15 events of 17 scenes", 17)
    assert (BASE.frequency, BASE.checks) == (CUT_INS, (PredictiveCheck("TTC < 5 s", 7, 15.9),))
    assert BASE.record["site"] == "US 101"
    assert EventCounts(used=(40,), clusters=1, cluster="drive").describe() == "40 events of 1 drive"
    assert EventCounts(used=(1,), clusters=1, cluster="event").describe() == "1 event"


def test_refits_are_distributions_of_the_same_coordinates_with_components_of_their_own() -> None:
    assert [len(refit.weights) for refit in BASE.refits if isinstance(refit, TruncatedGaussianMixture)] == [1, 2, 3]
    x = BASE.sample(50, np.random.default_rng(0))
    alone = TruncatedGaussianMixture.from_dict({**CONTENT, **CONTENT["refits"][2]})
    assert (BASE.refits[2].log_prob(x) == alone.log_prob(x)).all()


def test_the_ensemble_is_the_mean_of_the_refits() -> None:
    """Up to the mass outside the box, which is below 1e-3 for the typical points compared here."""
    ensemble = BASE.ensemble()
    assert isinstance(ensemble, TruncatedGaussianMixture)
    assert len(ensemble.weights) == 6
    np.testing.assert_allclose(ensemble.weights[:1], [1 / 3], rtol=1e-12)
    x = ensemble.sample(2000, np.random.default_rng(0))
    mean = np.mean([np.exp(refit.log_prob(x)) for refit in BASE.refits], axis=0)
    assert np.median(np.abs(np.exp(ensemble.log_prob(x)) / mean - 1.0)) < 1e-3
    u = np.random.default_rng(1).standard_normal((1000, 3))
    assert np.abs(ensemble.to_standard_normal(ensemble.from_standard_normal(u)) - u).max() < 1e-8


def test_a_covering_ensemble_has_at_most_30_refits_the_first_and_the_last_among_them() -> None:
    means = np.linspace(-1.0, 1.0, 100)
    refits = tuple(TruncatedGaussianMixture([1.0], [[m]], [[[1.0]]], [-9.0], [9.0]) for m in means)
    base = FittedDistribution(distribution=refits[0], refits=refits, events=COUNTS, family="1 component")
    pool = base.covering_ensemble()
    assert isinstance(pool, TruncatedGaussianMixture)
    assert len(pool.weights) == 30
    assert (pool.means.min(), pool.means.max()) == (-1.0, 1.0)
    few = replace(base, refits=refits[:3])
    x = few.sample(5, np.random.default_rng(0))
    assert (few.covering_ensemble().log_prob(x) == few.ensemble().log_prob(x)).all()


def test_an_ensemble_of_nothing_or_of_what_is_no_mixture() -> None:
    fit, refit = (TruncatedGaussianMixture([1.0], [[m]], [[[1.0]]], [-9.0], [9.0]) for m in (0.0, 2.0))
    base = FittedDistribution(distribution=fit, refits=(fit, refit), events=COUNTS, family="1 component")
    with pytest.raises(ValueError, match="There are no refits"):
        replace(base, refits=()).ensemble()
    beta = BetaDistribution([2.0], [2.0], [-9.0], [9.0])
    with pytest.raises(ValueError, match="needs refits that are Gaussian mixtures"):
        replace(base, refits=(fit, beta)).ensemble()


def test_a_refit_may_have_coordinates_of_its_own_also_in_a_file() -> None:
    plain = {"coordinates": ["plain"] * 3, "order": []}
    content = {**CONTENT, "refits": [CONTENT["refits"][0], CONTENT["refits"][0] | plain]}
    base = FittedDistribution.from_dict(content)
    own, other = base.refits
    assert isinstance(own, TruncatedGaussianMixture)
    assert isinstance(other, TruncatedGaussianMixture)
    assert own.coordinates.kinds != other.coordinates.kinds == ("plain",) * 3
    assert other.coordinates.order == ()
    assert base.refit_families == (0, 1)
    assert base.to_dict()["refits"] == content["refits"]


@pytest.mark.parametrize(
    ("refit", "message"),
    [
        (3, r"refits\[0\] with the four methods of a distribution, got int"),
        (BetaDistribution([2.0], [2.0], [0.0], [1.0]), r"refits\[0\] with dim 3 as its base, got 1"),
        (
            BetaDistribution([2.0] * 3, [2.0] * 3, [0.0] * 3, [45.0, 45.0, 150.0]),
            r"refits\[0\] with low \[0\. 0\. 1\.\] as its base",
        ),
    ],
)
def test_objects_that_are_no_refits(refit: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(BASE, refits=(refit,))


def test_siblings_are_found_by_name() -> None:
    found = FittedDistribution.from_dict(CONTENT, siblings={"i80": BASE}.__getitem__)
    assert found.sibling("i80") is BASE
    with pytest.raises(ValueError, match="knows no 'i80'; give an object"):
        BASE.sibling("i80")


def test_a_file_comes_back() -> None:
    assert BASE.to_dict() == CONTENT
    again = FittedDistribution.from_dict(json.loads(json.dumps(BASE.to_dict())))
    assert again.to_dict() == CONTENT
    x = BASE.sample(20, np.random.default_rng(0))
    for mine, read in zip(BASE.refits, again.refits, strict=True):
        assert (mine.log_prob(x) == read.log_prob(x)).all()


def test_beta_variables_may_have_refits() -> None:
    shapes = [{"alpha": [a], "beta": [3.0]} for a in (1.9, 2.1)]
    content = {"alpha": [2.0], "beta": [3.0], "low": [0.0], "high": [1.0], "refits": shapes}
    base = FittedDistribution.from_dict({**content, "events": {"used": [9], "clusters": 9}, "family": "Beta"})
    assert base.to_dict()["refits"] == shapes
    assert isinstance(base.distribution, BetaDistribution)


def test_what_a_file_cannot_hold() -> None:
    beta = BetaDistribution([2.0] * 3, [2.0] * 3, BASE.low, BASE.high)
    with pytest.raises(ValueError, match=r"refits\[0\] is of another kind than its base"):
        replace(BASE, refits=(beta,)).to_dict()
    with pytest.raises(ValueError, match="A file holds mixtures and Beta variables, no FittedDistribution"):
        replace(BASE, distribution=BASE).to_dict()


REFIT = CONTENT["refits"][0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"refits": "many"}, "Expected refits as a list of objects, got 'many'"),
        ({"refits": [3]}, r"Expected refits\[0\] as an object with weights, means, covariances, got 3"),
        ({"refits": [REFIT, {"weights": [1.0]}]}, r"refits\[1\] with weights, .*, got no means, covariances"),
        ({"refits": [{**REFIT, "weights": [0.5]}]}, r"^refits\[0\]: weights must sum to 1"),
        ({"events": {"used": [38], "clusters": 5, "scenes": 5}}, "got unknown scenes"),
        ({"events": {"used": [38, 15], "clusters": 54}}, "at most as many clusters as events, 53, got 54"),
        ({"family": ""}, "Expected family as a text, got ''"),
        ({"frequency": 9.0}, r"Expected frequency as an object with count, .*, got 9\.0"),
        ({"checks": {"name": "gap"}}, "Expected checks as a list of objects"),
    ],
)
def test_damage_is_told_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        FittedDistribution.from_dict({**CONTENT, **change})
    assert "\n" not in str(caught.value)


def test_a_missing_key_is_named() -> None:
    with pytest.raises(ValueError, match=r"^A file with refits, .*, frequency, checks lacks events\.$"):
        FittedDistribution.from_dict({name: value for name, value in CONTENT.items() if name != "events"})


BETA = BetaDistribution([2.0], [3.0], [0.0], [10.0])


def test_densities_add_up_and_maps_go_block_by_block() -> None:
    both = join_independent(BETA, NoiseDistribution(2))
    assert isinstance(both, ProductDistribution)
    assert (both.dim, both.noise.tolist()) == (3, [False, True, True])
    x = both.sample(50, np.random.default_rng(0))
    normal = -0.5 * (x[:, 1:] ** 2).sum(axis=1) - np.log(2.0 * np.pi)
    np.testing.assert_allclose(both.log_prob(x), BETA.log_prob(x[:, :1]) + normal, rtol=1e-12)
    u = both.to_standard_normal(x)
    np.testing.assert_array_equal(u[:, 1:], x[:, 1:])
    np.testing.assert_array_equal(u[:, :1], BETA.to_standard_normal(x[:, :1]))
    np.testing.assert_allclose(both.from_standard_normal(u), x, rtol=1e-9)


def test_a_product_with_one_fitted_block_is_fitted_too() -> None:
    whole = join_independent(BASE, BETA, NoiseDistribution(2))
    assert isinstance(whole, FittedDistribution)
    assert (whole.dim, whole.noise.tolist()) == (6, [False] * 4 + [True] * 2)
    assert [type(block) for block in whole.blocks] == [type(BASE.distribution), BetaDistribution, NoiseDistribution]
    assert (whole.fitted_to, whole.clusters, whole.family) == (BASE.fitted_to, BASE.clusters, BASE.family)
    assert (whole.frequency, whole.checks, whole.record) == (BASE.frequency, BASE.checks, BASE.record)


@pytest.mark.parametrize("first", [True, False])
def test_a_refit_replaces_its_block_alone(first: bool) -> None:
    whole = join_independent(*((BASE, BETA) if first else (BETA, BASE)))
    assert isinstance(whole, FittedDistribution)
    x = whole.sample(50, np.random.default_rng(0))
    own, rest = (x[:, :3], x[:, 3:]) if first else (x[:, 1:], x[:, :1])
    assert len(whole.refits) == 3
    for product, refit in zip(whole.refits, BASE.refits, strict=True):
        np.testing.assert_allclose(product.log_prob(x), refit.log_prob(own) + BETA.log_prob(rest), rtol=1e-12)
    ensemble = BASE.ensemble().log_prob(own) + BETA.log_prob(rest)
    np.testing.assert_allclose(whole.ensemble().log_prob(x), ensemble, rtol=1e-12)


def test_a_product_of_a_fitted_product_and_a_sibling() -> None:
    found = FittedDistribution.from_dict(BASE.to_dict(), siblings={"i80": BASE}.__getitem__)
    inner = join_independent(found, BETA)
    outer = join_independent(inner, NoiseDistribution(1))
    assert isinstance(outer, FittedDistribution)
    assert [block.dim for block in outer.blocks] == [3, 1, 1]
    assert [refit.dim for refit in outer.refits] == [5] * 3
    other = outer.sibling("i80")
    assert isinstance(other, FittedDistribution)
    assert (other.dim, other.fitted_to) == (5, BASE.fitted_to)
    assert join_independent(inner) is inner
    with pytest.raises(ValueError, match="A file holds mixtures and Beta variables, no ProductDistribution"):
        outer.to_dict()


def test_refits_of_two_fitted_blocks_do_not_belong_together() -> None:
    both = join_independent(BASE, BASE)
    assert type(both) is ProductDistribution
    assert [type(block) for block in both.blocks] == [type(BASE.distribution)] * 2
