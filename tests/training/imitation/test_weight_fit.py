"""The distribution of the last layers' weights of an ensemble: dependences recovered, penalty chosen, input refused."""

import json

import numpy as np
import pytest

from agents.learned.weight_distribution import WEIGHT_NAMES, WeightDistribution
from training.imitation import weight_fit
from training.imitation.weight_fit import fit_weights

D = 12
NAMES = tuple(f"w{j}" for j in range(D))


def chain() -> np.ndarray:
    """Precision of a chain: each weight depends on its neighbours alone."""
    return np.eye(D) * 2.0 + np.diag(np.full(D - 1, -0.9), 1) + np.diag(np.full(D - 1, -0.9), -1)


@pytest.fixture
def truth():
    return WeightDistribution(np.linspace(-1.0, 1.0, D), chain() * 1e4)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_it_finds_the_dependences_and_predicts_new_members(truth, rng):
    fit = fit_weights(truth.sample(200, rng), names=NAMES, shrinkage=0.05)
    beside = np.abs(np.diag(fit.distribution.precision, 1)) / np.abs(np.diag(fit.distribution.precision)).mean()
    assert (beside > 0.05).all()
    assert 0.0 < fit.metadata["nonzeros"] < 0.8
    new = truth.sample(2_000, rng)
    alone = WeightDistribution(fit.distribution.mean, np.diag(1 / fit.distribution.std**2))
    gain = fit.distribution.log_prob(new) - alone.log_prob(new)
    assert gain.mean() > 5 * gain.std() / np.sqrt(len(new))


def test_means_and_spreads_are_those_of_the_members(truth, rng):
    members = truth.sample(40, rng)
    fit = fit_weights(members, names=NAMES, radius=0.02)
    np.testing.assert_allclose(fit.distribution.mean, members.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(fit.distribution.std, members.std(axis=0, ddof=1), rtol=0.02)
    assert fit.distribution.radius == 0.02


def test_the_penalty_with_the_best_held_out_likelihood_is_taken(truth, rng):
    fit = fit_weights(truth.sample(60, rng), names=NAMES)
    tried = fit.metadata["tried"]
    scores = [row["held_out_log_likelihood"] for row in tried]
    best = tried[int(np.argmax(scores))]
    assert {name: fit.metadata[name] for name in best} == best
    assert [row["penalty"] for row in tried] == list(weight_fit.PENALTIES)
    assert fit.metadata["stopped"] == "no penalty left"
    assert json.loads(json.dumps(fit.metadata, allow_nan=False)) == fit.metadata


def test_held_out_likelihood_by_hand(truth, rng):
    """With a penalty over all correlations the weights are independent, fold by fold."""
    members = truth.sample(10, rng)
    fit = fit_weights(members, names=NAMES, penalties=(0.8,), folds=2)
    scores = []
    for held_out, rest in ((members[:5], members[5:]), (members[5:], members[:5])):
        z = (held_out - rest.mean(axis=0)) / rest.std(axis=0, ddof=1)
        scores.append((-0.5 * z**2 - np.log(rest.std(axis=0, ddof=1)) - 0.5 * np.log(2 * np.pi)).sum(axis=1))
    assert fit.metadata["held_out_log_likelihood"] == pytest.approx(np.mean(scores), rel=1e-9)
    assert (fit.metadata["nonzeros"], fit.metadata["condition"]) == (0.0, pytest.approx(1.0))


def test_independent_weights_keep_few_dependences(rng):
    fit = fit_weights(rng.standard_normal((60, D)), names=NAMES)
    assert fit.metadata["nonzeros"] < 0.1


def test_the_ladder_stops_at_the_first_failure(truth, rng, monkeypatch):
    members = truth.sample(60, rng)
    solve = weight_fit.graphical_lasso
    asked = []

    def fails_below(correlation, penalty, **settings):
        asked.append(penalty)
        if penalty < 0.4:
            raise FloatingPointError("Non SPD result")
        return solve(correlation, penalty, **settings)

    monkeypatch.setattr(weight_fit, "graphical_lasso", fails_below)
    fit = fit_weights(members, names=NAMES)
    assert [row["penalty"] for row in fit.metadata["tried"]] == [0.8, 0.7, 0.6, 0.5, 0.4]
    assert fit.metadata["penalty"] >= 0.4
    assert fit.metadata["stopped"] == "penalty 0.3 failed: Non SPD result"
    assert asked.count(0.3) == len(weight_fit.INNER_TOLERANCES)  # the coarser tolerance was tried too
    assert 0.25 not in asked
    with pytest.raises(ValueError, match=r"penalty 0\.3 failed: Non SPD result.*larger penalty"):
        fit_weights(members, names=NAMES, penalties=(0.3, 0.2))


@pytest.mark.parametrize("value", [0.25, np.nan, np.inf])
def test_an_inert_weight_is_named(rng, value):
    members = rng.standard_normal((10, 404))
    members[:, 303] = value
    assert WEIGHT_NAMES[303] == "log_std_yaw_rate_0"
    with pytest.raises(ValueError, match=r"1 of 404 are inert.*: log_std_yaw_rate_0"):
        fit_weights(members)


def test_a_weight_that_varies_in_one_fold_only_is_named(truth, rng):
    members = truth.sample(10, rng)
    members[2:, 3] = 0.1
    with pytest.raises(ValueError, match=r"inert.*: w3"):
        fit_weights(members, names=NAMES)


@pytest.mark.parametrize(
    ("members", "settings", "message"),
    [
        (np.zeros((10, 3)), {}, r"shape \(K, 12\), got \(10, 3\)"),
        (np.zeros((7, D)), {}, "7 members in 5 folds"),
        (np.zeros((10, D)), {"penalties": (0.1, 0.2)}, "descending"),
        (np.zeros((10, D)), {"penalties": ()}, "descending"),
        (np.zeros((10, D)), {"shrinkage": 1.0}, "shrinkage"),
    ],
)
def test_impossible_settings_are_refused(members, settings, message):
    with pytest.raises(ValueError, match=message):
        fit_weights(members, names=NAMES, **settings)


def test_the_global_generator_is_left_alone(truth, rng):
    members = truth.sample(20, rng)
    before = np.random.get_state()[1:3]  # noqa: NPY002
    fit_weights(members, names=NAMES)
    after = np.random.get_state()[1:3]  # noqa: NPY002
    np.testing.assert_array_equal(after[0], before[0])
    assert after[1] == before[1]


def test_all_404_weights_of_few_members(rng):
    """As many members and as dependent as ensembles are: a distribution is fitted, and its draws look like members."""
    directions = rng.standard_normal((5, 404))
    members = 0.003 * (rng.standard_normal((24, 5)) @ directions + 2.0 * rng.standard_normal((24, 404)))
    fit = fit_weights(members, penalties=(0.8, 0.5), folds=2)
    x = fit.distribution.sample(1_000, rng)
    np.testing.assert_allclose(x.std(axis=0), members.std(axis=0, ddof=1), rtol=0.15)
    assert fit.metadata["tried"][1]["nonzeros"] > 0.0
    assert fit.metadata["members"] == 24
