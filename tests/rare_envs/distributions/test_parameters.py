"""Parameters of distributions: names, units, round trips, and what must not change."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from rare_envs.distributions import (
    BetaDistribution,
    ClosingSpeed,
    Coordinates,
    EventCounts,
    FittedDistribution,
    NoiseDistribution,
    ProductDistribution,
    TruncatedGaussianMixture,
)

COVARIANCES = np.array([[[4.0, 1.2], [1.2, 1.0]], [[1.0, -0.3], [-0.3, 0.25]]])
PLAIN = TruncatedGaussianMixture([0.3, 0.7], [[1.0, 2.0], [-1.0, 0.5]], COVARIANCES, [-9.0, -9.0], [9.0, 9.0])
CLOSING = TruncatedGaussianMixture(
    [1.0],
    [[20.0, 3.0, 0.0]],
    [np.array([[9.0, 0.3, 0.0], [0.3, 0.25, 0.02], [0.0, 0.02, 0.04]])],
    coordinates=Coordinates(
        low=[0.0, 0.0, 1.0],
        high=[45.0, 45.0, 150.0],
        kinds=("plain", ClosingSpeed("speed", "gap"), "log"),
        names=("speed", "lead_speed", "gap"),
        order=("speed", "gap", "lead_speed"),
    ),
)
BETA = BetaDistribution([2.0, 3.0], [2.5, 1.5], [0.0, 1.0], [1.0, 9.0])
PRODUCT = ProductDistribution((BETA, NoiseDistribution(2), CLOSING))
FITTED = FittedDistribution(
    distribution=PLAIN, refits=(PLAIN,), events=EventCounts(used=(40,), clusters=12), family="2 components"
)
ALL = {"plain": PLAIN, "closing": CLOSING, "beta": BETA, "product": PRODUCT, "fitted": FITTED}


def values_of(distribution) -> np.ndarray:
    return np.array([each.value for each in distribution.parameters()])


@pytest.mark.parametrize("name", list(ALL))
def test_the_same_values_give_the_same_distribution(name: str) -> None:
    distribution = ALL[name]
    x = distribution.sample(200, np.random.default_rng(0))
    again = distribution.with_parameters(values_of(distribution))
    assert np.allclose(again.log_prob(x), distribution.log_prob(x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", list(ALL))
def test_every_parameter_moves_the_density_and_the_score_has_mean_zero(name: str) -> None:
    """The density stays one as a parameter moves: E[d log p / d theta] = 0 under the distribution, the box included."""
    distribution = ALL[name]
    x = distribution.sample(20_000, np.random.default_rng(1))
    values = values_of(distribution)
    for i, each in enumerate(distribution.parameters()):
        step = 1e-4 * each.change * (np.arange(len(values)) == i)
        above, below = (distribution.with_parameters(values + sign * step).log_prob(x) for sign in (1, -1))
        score = (above - below) / 2e-4
        assert score.std() > 0.01, each.name
        assert abs(score.mean()) < 4.5 * score.std() / np.sqrt(len(x)), each.name


def test_names_say_coordinate_and_component() -> None:
    names = [each.name for each in CLOSING.parameters(("ego_speed", "lead", "gap"))]
    coordinates = ("ego_speed", "log gap", "closing to lead")
    pairs = [f"correlation of {a} and {b}" for a, b in combinations(coordinates, 2)]
    assert names == [f"{what} of {each}" for what in ("mean", "sd") for each in coordinates] + pairs
    assert [each.columns for each in CLOSING.parameters()][:3] == [(0,), (2,), (1,)]  # of x, not of the coordinates
    assert PLAIN.parameters()[0].name == "weight of component 1"
    assert "mean of x2 (component 2)" in [each.name for each in PLAIN.parameters()]


def test_values_are_weights_means_standard_deviations_and_correlations() -> None:
    found = {each.name: each for each in PLAIN.parameters(("a", "b"))}
    assert found["weight of component 2"].value == 0.7
    assert found["mean of b (component 1)"][1:4] == (2.0, 1.0, "1 sd")
    assert found["sd of a (component 1)"][1:4] == (2.0, 0.2, "10 %")
    assert found["correlation of a and b (component 1)"].value == pytest.approx(0.6)
    values = values_of(PLAIN)
    values[:2] *= 5.0
    assert np.allclose(PLAIN.with_parameters(values).weights, PLAIN.weights)  # weights count in proportion


def test_blocks_without_parameters_stay_and_columns_are_those_of_the_whole() -> None:
    assert [each.columns for each in PRODUCT.parameters()][:5] == [(0,), (0,), (1,), (1,), (4,)]
    values = values_of(PRODUCT)
    values[0] = 7.0
    moved = PRODUCT.with_parameters(values)
    assert moved.blocks[0].alpha.tolist() == [7.0, 3.0]
    assert moved.blocks[1] == NoiseDistribution(2)


def test_components_are_numbered_like_those_of_another_mixture() -> None:
    arrays = PLAIN.weights[::-1], PLAIN.means[::-1] + 0.1, COVARIANCES[::-1]
    swapped = TruncatedGaussianMixture(*arrays, PLAIN.low, PLAIN.high)
    aligned = [each.value for each in swapped.parameters(like=PLAIN)]
    assert aligned[:2] == [0.3, 0.7]
    assert np.abs(np.array(aligned) - values_of(PLAIN)).max() == pytest.approx(0.1)
    assert [each.value for each in swapped.parameters(like=FITTED)] == aligned  # as refits are to their base
    refit = replace(FITTED, distribution=swapped)
    assert [each.value for each in refit.parameters(like=FITTED)] == aligned
    single = TruncatedGaussianMixture([1.0], PLAIN.means[:1], COVARIANCES[:1], PLAIN.low, PLAIN.high)
    assert len(single.parameters(like=PLAIN)) == 5  # other parameters: left as they are


def test_bad_values_are_refused() -> None:
    for distribution in (PLAIN, CLOSING, BETA, PRODUCT):
        with pytest.raises(ValueError, match="one for each parameter, got shape"):
            distribution.with_parameters([1.0, 2.0, 3.0])
    values = values_of(PLAIN)
    values[-1] = 1.5  # a correlation
    with pytest.raises(ValueError, match="not positive definite"):
        PLAIN.with_parameters(values)
    noise = replace(FITTED, distribution=NoiseDistribution(2), refits=())
    assert noise.parameters() == ()
    with pytest.raises(ValueError, match="A NoiseDistribution has no parameters"):
        noise.with_parameters([])
