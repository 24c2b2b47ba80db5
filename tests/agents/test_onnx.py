"""ONNX files as egos: exported ones act as the policies that they were made of, plain ones drive too."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stable_baselines3 as sb3
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

import rare_envs
from agents import load_ego
from agents.onnx import ACTION_TOLERANCE, compare_actions, export_onnx
from rare_envs.egos.needs import EgoWarning
from rare_envs.simulation.observation import count_features
from tests.agents.sb3.test_saved_ego import Still

pytest.importorskip("onnx", reason="the extra onnx is optional")
pytest.importorskip("onnxruntime", reason="the extra onnx is optional")
contrib = pytest.importorskip("sb3_contrib", reason="sb3-contrib is optional")
ENV = "rare_envs/CarFollowing-v0"
COLUMNS = count_features(2)


def vec_env(action_space: spaces.Space[Any] | None = None) -> DummyVecEnv:
    return DummyVecEnv([lambda: Still(action_space or spaces.Box(-1.0, 1.0, (2,), np.float32))])


def seen(env: VecNormalize) -> VecNormalize:
    env.seed(0)
    env.reset()
    for _ in range(30):
        env.step(np.zeros((1, 2), np.float32))
    return env


BUFFER = {"buffer_size": 10}


POLICIES: dict[str, Callable[[], Any]] = {
    "ppo": lambda: sb3.PPO("MlpPolicy", vec_env()),
    "ppo, other bounds": lambda: sb3.PPO("MlpPolicy", vec_env(spaces.Box(np.float32([-0.1, 0.0]), np.float32(0.01)))),
    "squashed": lambda: sb3.PPO("MlpPolicy", vec_env(), use_sde=True, policy_kwargs={"squash_output": True}),
    "sac": lambda: sb3.SAC("MlpPolicy", vec_env(spaces.Box(-2.0, 3.0, (2,), np.float32)), **BUFFER),
    "dqn": lambda: sb3.DQN("MlpPolicy", vec_env(spaces.Discrete(5)), **BUFFER),
    "normalised": lambda: sb3.PPO("MlpPolicy", seen(VecNormalize(vec_env(), clip_obs=1.0))),
    "stacked, then normalised": lambda: sb3.PPO("MlpPolicy", seen(VecNormalize(VecFrameStack(vec_env(), 3)))),
    "normalised, then stacked, recurrent": lambda: contrib.RecurrentPPO(
        "MlpLstmPolicy", VecFrameStack(seen(VecNormalize(vec_env())), 2)
    ),
}


@pytest.fixture
def saved(tmp_path: Path) -> Callable[[str], Any]:
    def save(name: str) -> Any:
        torch.manual_seed(0)
        model = POLICIES[name]()
        with torch.no_grad():
            for parameter in model.policy.parameters():
                parameter.add_(0.05 * torch.randn(parameter.shape))
        model.save(tmp_path / "ego.zip")
        if model.get_vec_normalize_env() is not None:
            model.get_vec_normalize_env().save(str(tmp_path / "vecnormalize.pkl"))
        return load_ego(tmp_path / "ego.zip")

    return save


@pytest.mark.parametrize("name", POLICIES)
def test_an_exported_policy_acts_as_before(name: str, saved: Any, tmp_path: Path) -> None:
    ego = saved(name)
    difference, _ = export_onnx(ego, tmp_path / "ego.onnx")
    again = load_ego(tmp_path / "ego.onnx")
    assert compare_actions(ego, again, np.random.default_rng(5))[0] <= ACTION_TOLERANCE
    assert difference <= ACTION_TOLERANCE
    assert again.action_space == ego.action_space
    assert again.observation_space.shape == ego.observation_space.shape
    assert (again.predict(np.ones((1, *ego.observation_space.shape), np.float32))[1] is not None) == (
        "normalised, then stacked" in name
    )
    assert sorted(path.name for path in tmp_path.glob("*onnx*")) == ["ego.onnx"]


def test_an_export_that_acts_otherwise_is_not_written(saved: Any, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("agents.onnx.ACTION_TOLERANCE", 1e-12)
    with pytest.raises(ValueError, match=r"acts differently, by up to .*; nothing was written"):
        export_onnx(saved("ppo"), tmp_path / "ego.onnx")
    assert list(tmp_path.glob("*onnx*")) == []


# --- files from elsewhere ----------------------------------------------------------------------


def write(
    module: nn.Module, path: Path, batch: int = 1, dynamic: bool = True, memory: Any = None, outputs: Any = None
) -> Path:
    """Plain PyTorch's export."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        examples = [torch.zeros(batch, COLUMNS), *([] if memory is None else [memory])]
        names, axes = ["obs", "h_in"][: len(examples)], {"obs": {0: "n"}, "h_in": {1: "n"}}
        options: dict[str, Any] = {"input_names": names, "output_names": outputs, "dynamo": False}
        given = {name: axes[name] for name in names} if dynamic else None
        torch.onnx.export(module, tuple(examples), str(path), dynamic_axes=given, **options)
    return path


@pytest.mark.parametrize("fixed", [None, 3])
def test_a_network_of_plain_pytorch_drives(fixed: int | None, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(COLUMNS, 16), nn.Tanh(), nn.Linear(16, 2)).requires_grad_(False)
    ego = load_ego(write(network, tmp_path / "ego.onnx", batch=fixed or 1, dynamic=fixed is None))
    assert ego.fixed_batch == fixed
    observation = np.random.default_rng(0).normal(size=(5, COLUMNS)).astype(np.float32)
    np.testing.assert_allclose(ego.predict(observation)[0], network(torch.from_numpy(observation)), atol=1e-6)


def test_the_best_of_five_scores_is_the_action(tmp_path: Path) -> None:
    network = nn.Linear(COLUMNS, 5).requires_grad_(False)
    ego, seen = load_ego(write(network, tmp_path / "ego.onnx")), torch.randn(20, COLUMNS)
    np.testing.assert_array_equal(ego.predict(seen)[0], network(seen).argmax(dim=1))
    assert ego.action_space == spaces.Discrete(5)


class Outputs(nn.Module):
    """A policy with all that Stable-Baselines3's `forward` returns, and what ML-Agents has beside."""

    def __init__(self, *order: str) -> None:
        super().__init__()
        self.layer, self.order = nn.Linear(COLUMNS, 2), order

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, ...]:
        found = {"actions": self.layer(obs), "values": obs.sum(1, keepdim=True), "log_prob": obs.sum(1)}
        found |= {"version": torch.ones(1), "drawn_actions": found["actions"] + torch.randn(2)}
        found["deterministic_actions"] = found["actions"]
        return tuple(found[name] for name in self.order)


@pytest.mark.parametrize(
    ("order", "names", "taken"),
    [
        ("actions values log_prob", "", 0),
        ("version values actions", "", 2),
        ("values actions", "values actions", 1),
        ("drawn_actions version deterministic_actions", "drawn_actions version deterministic_actions", 2),
    ],
)
def test_the_actions_are_known_by_their_name_or_their_form(order: str, names: str, taken: int, tmp_path: Path) -> None:
    network = Outputs(*order.split()).requires_grad_(False)
    ego = load_ego(write(network, tmp_path / "ego.onnx", outputs=names.split()))
    observation = np.random.default_rng(0).normal(size=(5, COLUMNS)).astype(np.float32)
    np.testing.assert_allclose(ego.predict(observation)[0], network.layer(torch.from_numpy(observation)), atol=1e-6)
    with pytest.warns(EgoWarning, match=r"output '\w+' of ego\.onnx is taken as the actions, not"):
        notes = rare_envs.DrivingProblem(ENV, ego=ego).notes
    chosen = names.split()[taken] if names else ego._outputs[0].name
    assert f"output {chosen!r}" in notes[0]


class Fixed(nn.Module):
    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        return obs[:, :2].reshape(4, 2)


class Recurrent(nn.Module):
    """Its memory has the layers first, as torch's own has."""

    def __init__(self) -> None:
        super().__init__()
        self.cell = nn.GRU(COLUMNS, 2, num_layers=2, batch_first=True)

    def forward(self, obs: torch.Tensor, h_in: torch.Tensor) -> tuple[torch.Tensor, ...]:
        actions, h_out = self.cell(obs[:, None], h_in)
        return obs.sum(1), h_out, actions[:, 0]


def test_a_batch_that_only_the_output_fixes_is_kept_to(tmp_path: Path) -> None:
    ego = load_ego(write(Fixed(), tmp_path / "ego.onnx", batch=4))
    assert ego.fixed_batch == 4
    observation = np.random.default_rng(0).normal(size=(10, COLUMNS)).astype(np.float32)
    np.testing.assert_array_equal(ego.predict(observation)[0], observation[:, :2])


def test_a_memory_with_its_layers_first_is_kept_row_by_row(tmp_path: Path) -> None:
    network = Recurrent().requires_grad_(False)
    names = ["values", "h_out", "actions"]
    write(network, tmp_path / "ego.onnx", memory=torch.zeros(2, 1, 2), outputs=names)
    ego, state, hidden = load_ego(tmp_path / "ego.onnx"), None, torch.zeros(2, 5, 2)
    for observation in np.random.default_rng(0).normal(size=(3, 5, COLUMNS)).astype(np.float32):
        action, state = ego.predict(observation, state)
        _, hidden, expected = network(torch.from_numpy(observation), hidden)
        np.testing.assert_allclose(action, expected, atol=1e-6)


class TwoMemories(nn.Module):
    def forward(self, obs: torch.Tensor, h0: torch.Tensor, c0: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return obs[:, :2] + h0, c0 + 10.0, h0 + 1.0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("after", [("c1", "h1"), ("cn", "hn"), ("next_c0", "next_h0"), ("c", "h_out")])
def test_memories_are_paired_by_their_names(after: tuple[str, str], tmp_path: Path) -> None:
    examples = torch.zeros(1, COLUMNS), torch.zeros(1, 2), torch.zeros(1, 2)
    names = {"input_names": ["obs", "h0", "c0"], "output_names": ["actions", *after]}
    torch.onnx.export(TwoMemories(), examples, str(tmp_path / "ego.onnx"), dynamo=False, **names)
    ego = load_ego(tmp_path / "ego.onnx")
    action, _ = ego.predict(np.zeros((2, COLUMNS)), ego.predict(np.zeros((2, COLUMNS)))[1])
    assert (action == 1.0).all()


class WithPrevious(nn.Module):
    """Its second output is no memory, and drives backwards."""

    def forward(self, obs: torch.Tensor, before: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return obs[:, :2] + 0.5 * before + 0.25, obs[:, :2] - 1.0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("before", ["prev_actions", "last_action", "previous_actions", "actions_in"])
def test_actions_that_are_their_own_memory_are_the_actions(before: str, tmp_path: Path) -> None:
    examples, file = (torch.zeros(1, COLUMNS), torch.zeros(1, 2)), tmp_path / "ego.onnx"
    names = {"input_names": ["obs", before], "output_names": ["actions", "log_std"], "dynamo": False}
    torch.onnx.export(WithPrevious(), examples, str(file), **names)
    ego = load_ego(file)
    first, state = ego.predict(np.zeros((3, COLUMNS)))
    assert (first == 0.25).all() and (ego.predict(np.zeros((3, COLUMNS)), state)[0] == 0.375).all()
    torch.onnx.export(WithPrevious(), examples, str(file), **{**names, "output_names": ["next_" + before, "mean"]})
    if before != "actions_in":  # which of both drives cannot be told
        with pytest.raises(ValueError, match=f"got next_{before}, mean; export it with one, named actions"):
            load_ego(file)


def test_files_of_another_form_are_refused(tmp_path: Path) -> None:
    (tmp_path / "broken.onnx").write_bytes(b"not a graph")
    with pytest.raises(ValueError, match=r"Cannot load .*broken\.onnx' as ONNX"):
        load_ego(tmp_path / "broken.onnx")
    with pytest.raises(ValueError, match=r"one input .* one output"):
        load_ego(write(Recurrent(), tmp_path / "two.onnx", memory=torch.zeros(2, 1, 2), outputs=["a", "b", "c"]))
    with pytest.raises(ValueError, match=r"one output .* got mean, log_std; export .* tanh of SAC's"):
        load_ego(write(Outputs("actions", "drawn_actions"), tmp_path / "a.onnx", outputs=["mean", "log_std"]))
    with pytest.raises(ValueError, match=r"acts in Box.*\(4,\)"):
        rare_envs.DrivingProblem(ENV, ego=load_ego(write(nn.Linear(COLUMNS, 4), tmp_path / "four.onnx")))
