"""Ensembles in miniature, and the distribution of their last layers: dependences recovered, penalty chosen."""

import json

import numpy as np
import pytest
import torch

from agents import read_driver, read_provenance
from agents.learned.networks import HEAD_SIZE, WeightDistribution, head_weights
from tests.training.imitation.synthetic_scenes import scenes, tiny
from training.imitation import weights as module
from training.imitation.train import DRIVER, Source, train_driver
from training.imitation.weights import Ensemble, fit_weights, make_ensemble, train_members

FEW = Ensemble(members=10, updates=2)
D = 12
NAMES = tuple(f"w{j}" for j in range(D))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mgail")
    with pytest.MonkeyPatch.context() as patch:
        for place in ("train", "weights"):
            patch.setattr(f"training.imitation.{place}.load_scenes", lambda source: (scenes(2, vehicles=6), ()))
        train_driver(Source("data", folder), tiny(updates=2, horizon=(2, 3), warm_up=1), folder)
        yield folder


def test_members_differ_and_the_driver_is_saved_with_their_distribution(run, monkeypatch):
    fit = module.fit_weights
    monkeypatch.setattr(module, "fit_weights", lambda members: fit(members, penalties=(0.8,), folds=2))
    members = train_members(run, FEW)
    weights = np.stack([member.weights for member in members])
    base = read_driver(run / DRIVER)
    assert weights.shape == (10, HEAD_SIZE)
    assert (weights.std(axis=0) > 0).all()  # none inert
    assert (np.abs(weights - head_weights(base.policy).numpy()).max(axis=1) > 0).all()
    path = make_ensemble(run, FEW, run / "whole.safetensors")
    driver, provenance = read_driver(path), read_provenance(path)
    np.testing.assert_allclose(driver.weights.mean, weights.mean(axis=0))
    for name, value in base.policy.state_dict().items():
        assert torch.equal(driver.policy.state_dict()[name], value)
    assert provenance.ensemble["members"] == 10
    assert provenance.ensemble["between_median"] > 0
    assert provenance.kind == read_provenance(run / DRIVER).kind


def test_members_are_kept_and_are_the_same_when_trained_again(run):
    kept = run / "members-2-0"
    first = train_members(run, FEW)
    path = kept / "004.npz"
    path.unlink()
    before = (kept / "003.npz").stat().st_mtime_ns
    again = train_members(run, FEW)
    assert (kept / "003.npz").stat().st_mtime_ns == before
    np.testing.assert_array_equal(first[4].weights, again[4].weights)
    np.savez(path, base=np.zeros(HEAD_SIZE), weights=first[4].weights, within=first[4].within)
    with pytest.raises(ValueError, match="another driver"):
        train_members(run, FEW)


def test_too_few_and_a_folder_without_a_training_are_refused(tmp_path):
    for settings, message in (
        ({"members": 9}, "10 or more members"),
        ({"updates": 1}, "2 or more updates"),
    ):
        with pytest.raises(ValueError, match=message):
            Ensemble(**settings)
    with pytest.raises(ValueError, match="Expected a training"):
        make_ensemble(tmp_path, FEW, tmp_path / "a.safetensors")


@pytest.fixture
def truth():
    """A chain: each weight depends on its neighbours alone."""
    beside = np.diag(np.full(D - 1, -0.9), 1)
    return WeightDistribution(np.linspace(-1.0, 1.0, D), (np.eye(D) * 2.0 + beside + beside.T) * 1e4)


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def test_it_finds_the_dependences_and_predicts_new_members(truth, rng):
    fit = fit_weights(truth.sample(200, rng), names=NAMES, shrinkage=0.05)
    beside = np.abs(np.diag(fit.distribution.precision, 1)) / np.abs(np.diag(fit.distribution.precision)).mean()
    assert (beside > 0.05).all()
    assert 0.0 < fit.metadata["nonzeros"] < 0.8
    new = truth.sample(2_000, rng)
    alone = WeightDistribution(fit.distribution.mean, np.diag(1 / np.diag(fit.distribution.covariance)))
    gain = fit.distribution.log_prob(new) - alone.log_prob(new)
    assert gain.mean() > 5 * gain.std() / np.sqrt(len(new))


def test_the_penalty_with_the_best_held_out_likelihood_is_taken(truth, rng):
    fit = fit_weights(truth.sample(60, rng), names=NAMES)
    tried = fit.metadata["tried"]
    scores = [row["held_out_log_likelihood"] for row in tried]
    best = tried[int(np.argmax(scores))]
    assert {name: fit.metadata[name] for name in best} == best
    assert [row["penalty"] for row in tried] == list(module.PENALTIES)
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


def test_the_ladder_stops_at_the_first_failure(truth, rng, monkeypatch):
    members = truth.sample(60, rng)
    solve = module.graphical_lasso
    asked = []

    def fails_below(correlation, penalty, **settings):
        asked.append(penalty)
        if penalty < 0.4:
            raise FloatingPointError("Non SPD result")
        return solve(correlation, penalty, **settings)

    monkeypatch.setattr(module, "graphical_lasso", fails_below)
    fit = fit_weights(members, names=NAMES)
    assert [row["penalty"] for row in fit.metadata["tried"]] == [0.8, 0.7, 0.6, 0.5, 0.4]
    assert fit.metadata["penalty"] >= 0.4
    assert fit.metadata["stopped"] == "penalty 0.3 failed: Non SPD result"
    assert asked.count(0.3) == len(module.INNER_TOLERANCES)  # the coarser tolerance was tried too
    assert 0.25 not in asked
    with pytest.raises(ValueError, match=r"penalty 0\.3 failed: Non SPD result.*larger penalty"):
        fit_weights(members, names=NAMES, penalties=(0.3, 0.2))


def test_an_inert_weight_is_named(rng):
    members = rng.standard_normal((10, 404))
    for value in (0.25, np.nan, np.inf):
        members[:, 303] = value
        with pytest.raises(ValueError, match=r"1 of 404 are inert.*: log_std_yaw_rate_0"):
            fit_weights(members)
