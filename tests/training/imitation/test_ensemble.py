"""Ensembles in miniature: the same trunk, other heads, resumed and reproducible, no weight inert."""

import dataclasses

import numpy as np
import pytest
import torch

from agents import read_driver, read_provenance
from agents.learned.networks import HEAD_SIZE, head_weights
from tests.training.imitation.synthetic_scenes import scenes, tiny
from training.imitation import ensemble as module
from training.imitation.algorithms.config import Config
from training.imitation.algorithms.expert_pairs import Pairs
from training.imitation.datasets import Source
from training.imitation.ensemble import (
    Ensemble,
    Member,
    make_ensemble,
    measure_spread,
    member_config,
    select_scenes,
    train_members,
)
from training.imitation.fit import prepare_data
from training.imitation.run_folder import DRIVER, train_driver

BASE = tiny(updates=2, epochs=2, horizon=(2, 3), warm_up=1)
FEW = Ensemble(members=10, updates=2)


@pytest.fixture(scope="module")
def made_up():
    with pytest.MonkeyPatch.context() as patch:
        for place in ("run_folder", "ensemble"):
            patch.setattr(f"training.imitation.{place}.load_scenes", lambda source: (scenes(3), ()))
        yield


@pytest.fixture(scope="module", params=["gail", "mgail"])
def run(request, made_up, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    train_driver(Source("data", folder), dataclasses.replace(BASE, method=request.param), folder)
    return folder


def test_members_differ_and_the_driver_is_saved_with_their_distribution(run, monkeypatch):
    fit = module.fit_weights
    monkeypatch.setattr(module, "fit_weights", lambda members: fit(members, penalties=(0.8,)))
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


def test_a_folder_without_a_training_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Expected a training"):
        make_ensemble(tmp_path, FEW, tmp_path / "a.safetensors")


def test_scenes_are_drawn_with_their_pairs_as_often_as_they_are_drawn():
    data = prepare_data(scenes(3))
    drawn = torch.tensor([2, 0, 2])
    pairs = select_scenes(data.pairs, drawn)
    count = [(data.pairs.scene == scene).sum() for scene in drawn]
    assert len(pairs.scene) == sum(count)
    assert (pairs.scene == 2).sum() == 2 * count[0]
    assert not (pairs.scene == 1).any()
    assert isinstance(pairs, Pairs)


def test_members_go_on_where_the_schedules_of_the_base_ended():
    config = member_config(Config(clone_weight=(0.1, 0.03), horizon=(15, 30)), Ensemble(updates=60))
    assert config.geometric_schedule(config.clone_weight, 0) == pytest.approx(0.03)
    assert config.horizon == (30, 30)
    assert config.warm_up == 0
    assert config.critic_weight == Config().critic_weight


def test_spread_on_paper():
    members = [Member(np.array([0.0, 1.0]), np.array([0.1, 0.2])), Member(np.array([2.0, 1.5]), np.array([0.3, 0.2]))]
    spread = measure_spread(members, base=np.array([0.0, 1.25]))
    assert spread["between_max"] == pytest.approx(np.sqrt(2))
    assert spread["within_median"] == pytest.approx(0.2)
    assert spread["bias_max"] == pytest.approx(1.0)
    assert spread["bias_over_spread"] == pytest.approx(np.sqrt(1.0 / (2.0 + 0.125)))


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"members": 9}, r"10 or more members.*, got 9\."), ({"updates": 1}, r"2 or more updates.*, got 1\.")],
)
def test_too_few_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        Ensemble(**settings)
