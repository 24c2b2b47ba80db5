"""An ego is trained on with the failures that an evaluation found: what is drawn, what is kept, what is refused."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
import training.ego_training
from agents import load_ego
from agents.sb3.saved_ego import load_saved_ego
from training import train_ego
from training.ego_retraining import (
    Retraining,
    ScenariosWithFailures,
    check_retrainable,
    continue_settings,
    restore_parameters,
)

ENV = "rare_envs/CutIn-v0"
FAILURE = np.array([[25.0, 12.0, 20.0, 2.0, 40.0, 3.5]])
STEPS, ROWS = 64, 8


def weights(path: Path) -> torch.Tensor:
    ego: Any = load_ego(path)
    return torch.cat([value.flatten().double() for value in ego.model.policy.state_dict().values()])


@pytest.fixture(scope="module")
def egos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("egos")
    for algo in ("ppo", "a2c", "sac", "td3", "dqn"):
        train_ego(ENV, algo, STEPS, num_envs=ROWS, out=folder / f"{algo}.zip", progress=False)
    return folder


def test_the_share_of_failures_is_drawn_and_the_rest_is_of_the_base() -> None:
    space = rare_envs.make_batch(ENV, 1).space
    mixed = ScenariosWithFailures(space.base, np.concatenate((FAILURE, FAILURE + 1.0)), 0.3)
    x = mixed.sample(20_000, np.random.default_rng(0))
    first, second = ((x == row).all(axis=1) for row in mixed.failures)
    assert first.sum() == pytest.approx(3000, abs=4 * np.sqrt(20_000 * 0.15 * 0.85))
    assert second.sum() == pytest.approx(3000, abs=4 * np.sqrt(20_000 * 0.15 * 0.85))
    rest = x[~first & ~second]
    usual = space.sample(20_000, np.random.default_rng(1))
    spread = np.sqrt(usual.var(axis=0) * (1 / len(rest) + 1 / len(usual)))
    assert (np.abs(rest.mean(axis=0) - usual.mean(axis=0)) < 4.5 * spread).all()


@pytest.mark.parametrize("algo", ["ppo", "a2c", "sac", "td3", "dqn"])
def test_every_algorithm_goes_on_from_the_weights_of_the_ego(
    algo: str, egos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[torch.Tensor] = []
    restore = training.ego_training.restore_parameters

    def restore_and_look(model: Any, saved: Any) -> None:
        restore(model, saved)
        started.append(torch.cat([value.flatten().double() for value in model.policy.state_dict().values()]))
        assert model.get_env().get_attr("space")[0].base.share == 0.5

    monkeypatch.setattr(training.ego_training, "restore_parameters", restore_and_look)
    given = Retraining(egos / f"{algo}.zip", FAILURE, share=0.5)
    path = train_ego(ENV, algo, STEPS, num_envs=ROWS, out=tmp_path / "on.zip", progress=False, retraining=given)
    before = weights(given.ego)
    assert torch.equal(started[0], before)
    assert not torch.equal(weights(path), before)


def test_a_resumed_retraining_ends_alike(egos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = Retraining(egos / "sac.zip", FAILURE, share=0.5)
    common: dict[str, Any] = {"algo": "sac", "steps": STEPS, "num_envs": ROWS, "progress": False}
    whole = train_ego(ENV, out=tmp_path / "whole.zip", retraining=given, **common)
    save = training.ego_training.save_checkpoint
    calls: list[None] = []

    def save_and_stop(*arguments: Any) -> None:
        save(*arguments)
        calls.append(None)
        if len(calls) == 4:
            raise InterruptedError

    monkeypatch.setattr(training.ego_training, "save_checkpoint", save_and_stop)
    with pytest.raises(InterruptedError):
        train_ego(ENV, out=tmp_path / "on.zip", retraining=given, checkpoint_interval=0.0, **common)
    monkeypatch.undo()
    for other in (None, Retraining(egos / "sac.zip", FAILURE, 0.4), Retraining(egos / "sac.zip", FAILURE + 0.1, 0.5)):
        with pytest.raises(ValueError, match="is of a training with other arguments"):
            train_ego(ENV, out=tmp_path / "on.zip", retraining=other, resume=True, **common)
    resumed = train_ego(ENV, out=tmp_path / "on.zip", retraining=given, resume=True, **common)
    assert torch.equal(weights(resumed), weights(whole))


def test_sac_keeps_its_entropy_coefficient(egos: Path) -> None:
    saved = load_saved_ego(egos / "sac.zip", None)
    from stable_baselines3 import SAC

    from training.vec_env import sb3_vec_env

    model = SAC("MlpPolicy", sb3_vec_env(ENV, 2), policy_kwargs=saved.model.policy_kwargs, device="cpu")
    fresh = model.log_ent_coef.item()
    restore_parameters(model, saved)
    assert model.log_ent_coef.item() != fresh


def test_what_does_not_fit_is_refused_before_training(egos: Path, tmp_path: Path) -> None:
    out = {"out": tmp_path / "on.zip", "progress": False, "steps": STEPS, "num_envs": ROWS}
    with pytest.raises(ValueError, match=r"Expected an ego trained by ppo, got .*a2c.zip.*, trained by a2c"):
        train_ego(ENV, "ppo", retraining=Retraining(egos / "a2c.zip", FAILURE), **out)
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 6\)"):
        train_ego(ENV, "ppo", retraining=Retraining(egos / "ppo.zip", FAILURE[:, :3]), **out)
    with pytest.raises(ValueError, match="ego_speed = 99 is outside its range"):
        train_ego(ENV, "ppo", retraining=Retraining(egos / "ppo.zip", np.full((1, 6), 99.0)), **out)
    with pytest.raises(ValueError, match="its observation_space is"):
        train_ego(ENV, "ppo", retraining=Retraining(egos / "ppo.zip", FAILURE), observation="lidar", **out)
    with pytest.raises(FileNotFoundError, match=r"No ego at .*pp0\.zip"):
        train_ego(ENV, "ppo", retraining=Retraining(egos / "pp0.zip", FAILURE), **out)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, None),
        ({"algorithm": "a2c"}, r"^Expected an ego trained by ppo, got 'ego\.zip', trained by a2c\.$"),
        ({"statistics": object()}, "trained behind VecNormalize, train-ego has none"),
        ({"model": SimpleNamespace(observation_space=4, action_space=2)}, "its observation_space is 4, .* is 3"),
        ({"model": SimpleNamespace(observation_space=3, action_space=5)}, "its action_space is 5, .* is 2"),
    ],
)
def test_an_ego_trained_otherwise_is_refused(changed: dict[str, Any], said: str | None) -> None:
    env = SimpleNamespace(observation_space=3, action_space=2)  # anything that compares as spaces do
    usual = {"path": Path("ego.zip"), "algorithm": "ppo", "statistics": None, "model": env}
    saved = SimpleNamespace(**{**usual, **changed})
    if said is None:
        check_retrainable(saved, "ppo", env)
        return
    with pytest.raises(ValueError, match=said):
        check_retrainable(saved, "ppo", env)


def test_a_training_that_goes_on_explores_as_at_its_end_and_learns_at_once() -> None:
    dqn = {"learning_starts": 100, "exploration_initial_eps": 1.0, "exploration_final_eps": 0.05, "gamma": 0.9}
    before = dict(dqn)
    assert continue_settings(dqn) == {**dqn, "learning_starts": 0, "exploration_initial_eps": 0.05}
    assert dqn == before
    assert continue_settings({"n_steps": 8}) == {"n_steps": 8}  # PPO has none of these arguments


@pytest.mark.parametrize("share", [0.0, 1.0, -0.1, float("nan")])
def test_a_share_keeps_both_kinds(share: float) -> None:
    with pytest.raises(ValueError, match="share of failures above 0 and below 1"):
        Retraining(Path("ego.zip"), FAILURE, share)
