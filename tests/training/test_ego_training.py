"""Egos are trained, taken up where they were stopped, and trained on with the failures that an evaluation found."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3
import torch
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy

import agents
import rare_envs
import training.ego_training
from agents import SavedEgo, load_ego
from agents.saved_ego import load_saved_ego
from examples.demo import ENV_ID, random_collision_rate
from rare_envs import DrivingProblem
from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.startup import use_one_thread
from training import ego_training, sb3_vec_env, train_ego
from training.checkpoints import TrainingInterrupted, load_checkpoint
from training.ego_training import HYPERPARAMETERS, Retraining, check_retrainable, restore_parameters

ENV = "rare_envs/CutIn-v0"
STEPS, ROWS = 64, 8
ALGORITHMS = ("ppo", "a2c", "sac", "td3", "dqn")
EACH = [pytest.param(algo, marks=() if algo in ("ppo", "dqn") else pytest.mark.slow) for algo in ALGORITHMS]
FACTOR = 20.0
"""After 100,000 steps."""
FAILURE = np.array([[25.0, 12.0, 20.0, 2.0, 40.0, 3.5]])


def weights(path: Path) -> torch.Tensor:
    ego: Any = load_ego(path)
    return torch.cat([value.flatten().double() for value in ego.policy.state_dict().values()])


@pytest.mark.parametrize("algo", EACH)
def test_every_algorithm_trains_saves_and_drives(algo: str, tmp_path: Path) -> None:
    path = train_ego(ENV, algo, steps=400, num_envs=16, out=tmp_path / "new" / "ego", progress=False)
    assert path == tmp_path / "new" / "ego.zip"
    ego = load_ego(path)
    assert isinstance(ego, SavedEgo)
    assert ego.algorithm == algo
    env = sb3_vec_env(ENV, 4, seed=0, action="discrete" if algo == "dqn" else "continuous")
    assert ego.observation_space == env.observation_space
    expected = spaces.Discrete(len(DISCRETE_ACTIONS)) if algo == "dqn" else env.action_space
    assert ego.action_space == expected
    returns, lengths = evaluate_policy(ego, env, n_eval_episodes=4, return_episode_rewards=True)
    assert np.isfinite(returns).all()
    assert min(lengths) > 0  # type: ignore[type-var]
    problem = DrivingProblem(ENV, ego=ego)
    f = problem.evaluate(problem.base.sample(8, np.random.default_rng(0)))
    assert ((f == -1.0) | (f > 0.0)).all()


@pytest.mark.parametrize("algo", ["dqn", pytest.param("sac", marks=pytest.mark.slow)])
def test_several_observations_are_learnt_from_without_returns_of_several_steps(algo: str, tmp_path: Path) -> None:
    """Stable-Baselines3 has such returns for an array, not for a dictionary of them."""
    path = train_ego(ENV, algo, 32, 0, 4, out=tmp_path / "ego", progress=False, observation="features+lidar")
    assert set(load_ego(path).observation_space) == {"features", "lidar"}  # type: ignore[attr-defined]


@pytest.mark.slow
@use_one_thread()
def test_a_trained_ego_collides_far_less_than_a_random_policy(tmp_path: Path) -> None:
    path = train_ego(ENV_ID, steps=100_000, seed=0, out=tmp_path / "ego.zip", progress=False)
    problem = rare_envs.DrivingProblem(ENV_ID, ego=agents.load_ego(str(path)))
    x = problem.base.sample(4_000, np.random.default_rng(1))
    collisions = int((problem.evaluate(x) <= 0.0).sum())
    # three standard errors of the count above what was seen
    assert (collisions + 3.0 * max(collisions, 1) ** 0.5) / len(x) < random_collision_rate() / FACTOR


def test_bad_requests_are_refused_before_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"steps": 0}, "steps >= 1, got 0"),
        ({"env_id": "CutInn-v1", "out": "new/ego"}, "did you mean 'rare_envs/CutIn-v1'"),
        ({"algo": "pp0"}, r"Unknown algorithm 'pp0' \(did you mean 'ppo'\?\)"),
        ({"algo": "sac", "action": "discrete"}, "Expected continuous actions .* with sac; ppo, a2c and dqn take"),
        ({"num_envs": 0}, "num_envs >= 1, got 0"),
        ({"out": "."}, "got the folder"),
        ({"out": "file/ego.zip"}, "Cannot make the folder"),
        ({"out": "ego.zip", "resume": True}, "There is no training to resume"),
    )
    for arguments, message in cases:
        with pytest.raises(ValueError, match=message) as caught:
            train_ego(**{"env_id": ENV, **arguments})
        assert "\n" not in str(caught.value)
        assert [path.name for path in tmp_path.iterdir()] == ["file"]


def stop_after(monkeypatch: pytest.MonkeyPatch, algo: str, count: int) -> None:
    """Let Ctrl-C come after so many calls of an algorithm's `train`."""
    algorithm, made = getattr(stable_baselines3, algo.upper()), [0]
    train = algorithm.train

    def train_and_stop(*arguments: Any, **more: Any) -> None:
        train(*arguments, **more)
        made[0] += 1
        if made[0] == count:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(algorithm, "train", train_and_stop)


@pytest.mark.parametrize(
    ("algo", "steps", "trained"),
    [("ppo", 480, 1), *(pytest.param(each, 160, 5, marks=pytest.mark.slow) for each in ("sac", "td3", "dqn"))],
)
def test_a_resumed_training_ends_alike(
    algo: str, steps: int, trained: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stopped half-way, with updates, and new scenarios for episodes that ended (after 0.8 s), before and after."""
    ids = ("rare_envs/HardBrake-v0", ENV) if algo == "ppo" else ENV
    common: dict[str, Any] = {"algo": algo, "steps": steps, "num_envs": ROWS, "progress": False, "horizon": 0.8}
    whole = train_ego(ids, out=tmp_path / "whole.zip", **common)
    stop_after(monkeypatch, algo, trained)
    with pytest.raises(TrainingInterrupted, match=r"^Stopped: \d+ of \d+ steps are kept .* with --resume\.$"):
        train_ego(ids, out=tmp_path / "ego.zip", **common)
    monkeypatch.undo()
    assert not (tmp_path / "ego.zip").exists()
    with pytest.raises(ValueError, match=r"There is an unfinished training in .* go on with --resume"):
        train_ego(ids, out=tmp_path / "ego.zip", **common)
    with pytest.raises(ValueError, match=r"with other arguments \(seed=0\)"):
        train_ego(ids, out=tmp_path / "ego.zip", resume=True, **{**common, "seed": 1})
    other = {algo: replace(HYPERPARAMETERS[algo], reward_scale=0.5)}
    monkeypatch.setattr(ego_training, "HYPERPARAMETERS", other)
    with pytest.raises(ValueError, match=r"with other arguments \(settings='\w{8}'\)"):
        train_ego(ids, out=tmp_path / "ego.zip", resume=True, **common)
    monkeypatch.undo()
    np.random.seed(5)  # noqa: NPY002  (what another process would have drawn of the global generators)
    torch.manual_seed(5)
    resumed = train_ego(ids, out=tmp_path / "ego.zip", resume=True, **common)
    assert torch.equal(weights(resumed), weights(whole))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ego.zip", "whole.zip"]


def test_damaged_checkpoints_are_refused_in_one_line(tmp_path: Path) -> None:
    damaged = io.BytesIO()
    torch.save({"arguments": "{", "format": 1}, damaged)
    for content in (b"", b"noise", b"PK\x03\x04", b"\x80\x02cos\nsystem\n.", damaged.getvalue()):
        (tmp_path / "ego.checkpoint").write_bytes(content)
        with pytest.raises(ValueError, match="it is damaged or no checkpoint; remove it") as caught:
            load_checkpoint(tmp_path / "ego.checkpoint", {})
        assert "\n" not in str(caught.value)


def test_an_ego_stays_while_the_next_one_cannot_be_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "ego.zip").write_bytes(b"earlier")
    monkeypatch.setattr(training.ego_training, "replace_file", full)
    common: dict[str, Any] = {"steps": 64, "num_envs": 4, "out": tmp_path / "ego.zip", "progress": False}
    with pytest.raises(ValueError, match=r"There is .*ego\.zip' already: .* --force"):
        train_ego(ENV, **common)
    with pytest.raises(OSError, match=r"No space left on device\. \d+ of 64 steps are kept .* with --resume"):
        train_ego(ENV, force=True, **common)
    assert (tmp_path / "ego.zip").read_bytes() == b"earlier"
    monkeypatch.undo()
    train_ego(ENV, force=True, resume=True, **common)
    assert [path.name for path in tmp_path.iterdir()] == ["ego.zip"]


PROGRAM = """
import sys
from training import train_ego
train_ego("rare_envs/CutIn-v0", "a2c", 20_000, num_envs=8, out=sys.argv[1], progress=False, checkpoint_interval=0.0,
          resume=sys.argv[2] == "resume")
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_training_is_taken_up(tmp_path: Path) -> None:
    """Killed three times at different moments, one of them perhaps while a checkpoint is written."""
    whole = train_ego(ENV, "a2c", 20_000, num_envs=8, out=tmp_path / "whole.zip", progress=False)
    out, checkpoint = tmp_path / "ego.zip", tmp_path / "ego.checkpoint"
    for delay in (0.1, 0.73, 1.31):
        how = "resume" if checkpoint.exists() else "begin"
        with subprocess.Popen([sys.executable, "-c", PROGRAM, str(out), how]) as process:
            while not checkpoint.exists() and process.poll() is None:
                time.sleep(0.05)
            time.sleep(delay + (5.0 if how == "resume" else 0.0))
            process.send_signal(signal.SIGKILL)
    assert checkpoint.exists()
    assert not out.exists()
    subprocess.run([sys.executable, "-c", PROGRAM, str(out), "resume"], check=True)
    assert torch.equal(weights(out), weights(whole))


@pytest.fixture(scope="module")
def egos(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return what trains an ego by an algorithm, once."""
    folder = tmp_path_factory.mktemp("egos")
    return cache(lambda algo: train_ego(ENV, algo, STEPS, num_envs=ROWS, out=folder / f"{algo}.zip", progress=False))


def test_an_ego_is_trained_in_several_scenarios(tmp_path: Path) -> None:
    ids = ("rare_envs/HardBrake-v0", ENV)
    common: dict[str, Any] = {"steps": STEPS, "num_envs": ROWS, "progress": False, "horizon": 0.8}
    whole = train_ego(ids, out=tmp_path / "both.zip", **common)
    for each in ids:
        problem = DrivingProblem(each, ego=load_ego(whole))
        assert np.isfinite(problem.evaluate(problem.base.sample(4, np.random.default_rng(0)))).all()
    for wrong in ((), (ENV, ENV)):
        with pytest.raises(ValueError, match="different environments, one or more"):
            train_ego(wrong, out=tmp_path / "none.zip", **common)
    with pytest.raises(ValueError, match="one environment to train on in"):
        train_ego(ids, out=tmp_path / "none.zip", retraining=Retraining(whole, FAILURE), **common)


def test_episodes_that_follow_begin_in_failures_too() -> None:
    """With episodes of one step nearly all begin after another one; the count is binomial, to 5 deviations."""
    env = sb3_vec_env(ENV, 8, seed=0, horizon=0.1)
    env.set_attr("space", Retraining(Path("ego.zip"), FAILURE, 0.5).mix(env.get_attr("space")[0]))
    env.reset()
    infos = [info for _ in range(100) for info in env.step(np.zeros((8, 2), np.float32))[3]]
    failed = sum(bool((info["x"] == FAILURE[0]).all()) for info in infos)
    assert failed == pytest.approx(400, abs=5 * (800 * 0.25) ** 0.5)


def test_the_share_of_failures_is_drawn_and_the_rest_is_of_the_base() -> None:
    space, failures = gym.make_vec(ENV, 1).space, np.concatenate((FAILURE, FAILURE + 1.0))
    x = Retraining(Path("ego.zip"), failures, 0.3).mix(space).base.sample(20_000, np.random.default_rng(0))
    first, second = ((x == row).all(axis=1) for row in failures)
    for drawn in (first, second):
        assert drawn.sum() == pytest.approx(3000, abs=4 * np.sqrt(20_000 * 0.15 * 0.85))
    rest = x[~first & ~second]
    usual = space.sample(20_000, np.random.default_rng(1))
    spread = np.sqrt(usual.var(axis=0) * (1 / len(rest) + 1 / len(usual)))
    assert (np.abs(rest.mean(axis=0) - usual.mean(axis=0)) < 4.5 * spread).all()


@pytest.mark.parametrize("algo", EACH)
def test_every_algorithm_goes_on_from_the_weights_of_the_ego(
    algo: str, egos: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[torch.Tensor] = []
    restore = training.ego_training.restore_parameters

    def restore_and_look(model: Any, saved: Any) -> None:
        restore(model, saved)
        started.append(torch.cat([value.flatten().double() for value in model.policy.state_dict().values()]))

    monkeypatch.setattr(training.ego_training, "restore_parameters", restore_and_look)
    given = Retraining(egos(algo), FAILURE, share=0.5)
    path = train_ego(ENV, algo, STEPS, num_envs=ROWS, out=tmp_path / "on.zip", progress=False, retraining=given)
    before = weights(given.ego)
    assert torch.equal(started[0], before)
    assert not torch.equal(weights(path), before)


def test_a_resumed_retraining_ends_alike(
    egos: Callable[[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = Retraining(egos("sac"), FAILURE, share=0.5)
    common: dict[str, Any] = {"algo": "sac", "steps": STEPS, "num_envs": ROWS, "progress": False}
    whole = train_ego(ENV, out=tmp_path / "whole.zip", retraining=given, **common)
    stop_after(monkeypatch, "sac", 2)
    with pytest.raises(TrainingInterrupted):
        train_ego(ENV, out=tmp_path / "on.zip", retraining=given, **common)
    monkeypatch.undo()
    for other in (None, Retraining(egos("sac"), FAILURE, 0.4), Retraining(egos("sac"), FAILURE + 0.1, 0.5)):
        with pytest.raises(ValueError, match="is of a training with other arguments"):
            train_ego(ENV, out=tmp_path / "on.zip", retraining=other, resume=True, **common)
    resumed = train_ego(ENV, out=tmp_path / "on.zip", retraining=given, resume=True, **common)
    assert torch.equal(weights(resumed), weights(whole))


def test_what_does_not_fit_is_refused_before_training(egos: Callable[[str], Path], tmp_path: Path) -> None:
    out = {"out": tmp_path / "on.zip", "progress": False, "steps": STEPS, "num_envs": ROWS}
    wrong: tuple[tuple[Path, np.ndarray, dict[str, Any], str], ...] = (
        (egos("sac"), FAILURE, {}, r"Expected an ego trained by ppo, got .*sac.zip.*, trained by sac"),
        (egos("ppo"), FAILURE[:, :3], {}, r"Expected x of shape \(n, 6\)"),
        (egos("ppo"), np.full((1, 6), 99.0), {}, "ego_speed = 99 is outside its range"),
        (egos("ppo"), FAILURE, {"observation": "lidar"}, "its observation_space is"),
        (tmp_path / "pp0.zip", FAILURE, {}, r"No ego at .*pp0\.zip"),
    )
    for path, failures, more, message in wrong:
        with pytest.raises((ValueError, FileNotFoundError), match=message):
            train_ego(ENV, "ppo", retraining=Retraining(path, failures), **out, **more)
    assert not list(tmp_path.iterdir())
    env = SimpleNamespace(observation_space=3, action_space=2)  # anything that compares as spaces do
    usual = {"path": Path("ego.zip"), "algorithm": "ppo", "statistics": None, "policy": env}
    other = SimpleNamespace(observation_space=3, action_space=5)
    with pytest.raises(ValueError, match="trained behind VecNormalize, train-ego has none"):
        check_retrainable(SimpleNamespace(**{**usual, "statistics": object()}), "ppo", env)
    with pytest.raises(ValueError, match=r"its action_space is 5, .* is 2"):
        check_retrainable(SimpleNamespace(**{**usual, "policy": other}), "ppo", env)


def test_sac_keeps_its_entropy_coefficient(egos: Callable[[str], Path]) -> None:
    saved = load_saved_ego(egos("sac"), None)
    model = SAC("MlpPolicy", sb3_vec_env(ENV, 2), policy_kwargs=saved.policy_kwargs, device="cpu")
    fresh = model.log_ent_coef.item()
    restore_parameters(model, saved)
    assert model.log_ent_coef.item() != fresh
