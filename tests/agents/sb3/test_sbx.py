"""Policies of sbx, Stable-Baselines3 in JAX: files laid out as it writes them act as its equations say, without JAX."""

from __future__ import annotations

import base64
import json
import pickle
import sys
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from agents import load_ego
from rare_envs.egos.dense_policies import NotCompiled, read_dense_policy
from tests.agents.sb3.hostile_files import Call

FUNCTIONS = "jax._src.nn.functions"
SQUASHED = "sbx.common.policies.SquashedGaussianActor"
NAMES = {
    "ppo": ("sbx.ppo.policies.PPOPolicy", "sbx.ppo.policies.Actor", "clip_range"),
    "sac": ("sbx.sac.policies.SACPolicy", SQUASHED, "target_entropy"),
    "tqc": ("sbx.tqc.policies.TQCPolicy", SQUASHED, "ent_coef"),
    "td3": ("sbx.td3.policies.TD3Policy", "sbx.td3.policies.Actor", "target_policy_noise"),
    "dqn": ("sbx.dqn.policies.DQNPolicy", "sbx.dqn.policies.QNetwork", "exploration_initial_eps"),
}
SEEN = spaces.Box(-1.0, 1.0, (11,), np.float32)
TABLE = spaces.Box(-1.0, 1.0, (5, 5), np.float32)
BOX = spaces.Box(np.float32([-3.0, -1.0]), np.float32([5.0, 1.0]))
FIVE = spaces.Discrete(5)
APPLIED = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0.0),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, 0.0))),
    "silu": lambda x: x / (1.0 + np.exp(-x)),
    "leaky_relu": lambda x: np.where(x > 0.0, x, 0.01 * x),
    "gelu": lambda x: 0.5 * x * (1.0 + np.tanh(np.sqrt(2.0 / np.pi) * (x + 0.044715 * x**3))),
}


class Files:
    """Writes files of sbx; what their pickles name is there while they are written."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.path, self.patch, self.rng = folder / "ego.zip", patch, np.random.default_rng(0)

    def name(self, name: str) -> Any:
        module, _, attribute = name.rpartition(".")
        for held in (module.partition(".")[0], module):
            if not isinstance(sys.modules.get(held), Holder):
                self.patch.setitem(sys.modules, held, Holder(held))
        holder = sys.modules[module]
        if not hasattr(holder, attribute):
            setattr(holder, attribute, type(attribute, (), {"__module__": module}))
        return getattr(holder, attribute)

    def fill(self, name: str, **state: Any) -> Any:
        value = self.name(name)()
        vars(value).update(state)
        return value

    def array(self, numbers: np.ndarray) -> Any:
        function, arguments, state = numbers.__reduce__()
        return Call(self.name("jax._src.array._reconstruct_array"), function, arguments, state, {"weak_type": False})

    def activation(self, name: str, module: str = FUNCTIONS) -> Any:
        if name == "relu":
            return self.fill("jax._src.custom_derivatives.custom_jvp", __name__=name, __module__=module)
        if name == "gelu":
            return self.name(f"{module}.gelu")
        built = Call(self.name("cloudpickle.cloudpickle._builtin_type"), "CodeType")
        code = Call(self.name("cloudpickle.cloudpickle._make_function"), built, {"__name__": module})
        return self.fill("jaxlib._jax.PjitFunction", function_name=name, fun=code)

    def write(self, algorithm: str, seen: Any, acts: Any, *function: str, **changed: Any) -> list[Any]:
        kind, network, setting = NAMES[algorithm]
        size, heads = acts.n if acts is FIVE else acts.shape[0], 2 if network == SQUASHED else 1
        shapes = [(int(np.prod(seen.shape)), 16), (16, 8), *[(8, size)] * heads]
        layers = [(self.rng.normal(0.0, 0.4, each), self.rng.normal(0.0, 0.4, each[1])) for each in shapes]
        layers = [tuple(one.astype(np.float32) for one in layer) for layer in layers]
        dense = {
            f"Dense_{at}": {"kernel": self.array(kernel), "bias": self.array(bias)}
            for at, (kernel, bias) in enumerate(layers)
        }
        own = {"log_std": self.array(np.zeros(size, np.float32))} if (algorithm, acts) == ("ppo", BOX) else {}
        params = {"params": {**dense, **own, **changed.get("params", {})}}
        at = "qf" if algorithm == "dqn" else "actor"
        trained = self.fill("flax.training.train_state.TrainState", params=params)
        acting = self.fill(changed.get("network", network), activation_fn=self.activation(*function))
        policy = self.fill(kind, **{at: acting, f"{at}_state": trained, "more": changed.get("more")})
        held = {"policy": policy, "policy_class": self.name(kind), "observation_space": seen, "action_space": acts}
        data: dict[str, Any] = {setting: 0.1, "policy_kwargs": {}}
        for name, value in held.items():
            data[name] = {":serialized:": base64.b64encode(pickle.dumps(value)).decode(), "__module__": kind}
        with zipfile.ZipFile(self.path, "w") as archive:
            archive.writestr("data", json.dumps(data))
        self.patch.undo()
        return layers


class Holder(ModuleType):
    """A module of names."""


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path, pytest.MonkeyPatch())


CASES = [
    *[("ppo", SEEN, BOX, name) for name in APPLIED],
    *[(name, TABLE, acts, "relu") for name, acts in zip(NAMES, (FIVE, BOX, BOX, BOX, FIVE), strict=True)],
]


@pytest.mark.parametrize(("algorithm", "space", "acts", "name"), CASES)
def test_a_file_of_sbx_acts_as_its_layers(algorithm: str, space: Any, acts: Any, name: str, files: Files) -> None:
    layers = files.write(algorithm, space, acts, name)
    ego: Any = load_ego(files.path)
    seen = files.rng.normal(0.0, 1.0, (100, *space.shape)).astype(np.float32)
    values = seen.reshape(100, -1).astype(float)
    for kernel, bias in layers[:2]:
        values = APPLIED[name](values @ kernel + bias)
    values = values @ layers[2][0] + layers[2][1]
    squashed = BOX.low + (np.tanh(values) + 1.0) * (BOX.high - BOX.low) / 2.0 if acts is BOX else None
    clipped = values.clip(BOX.low, BOX.high) if acts is BOX else values.argmax(1)
    expected = clipped if algorithm in ("ppo", "dqn") else squashed
    np.testing.assert_allclose(ego.predict(seen)[0], expected, atol=1e-5)
    assert ego.algorithm == algorithm and len(np.unique(expected, axis=0)) > 2
    if algorithm in ("ppo", "dqn") and name in ("tanh", "relu"):
        assert len(read_dense_policy(ego).layers) == 3
    else:
        with pytest.raises(NotCompiled):
            read_dense_policy(ego)


def test_what_is_not_known_is_refused_with_what_to_do_and_no_code_runs(files: Files, tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    layer = {"LayerNorm_0": {"scale": np.ones(8, np.float32)}}
    tanh = ("tanh", "jax._src.numpy.ufuncs")
    cases = {
        "its activation mine.tanh is": (("tanh", "mine"), {}),
        "its activation hard_tanh": (("hard_tanh",), {}),
        "Simba": (tanh, {"network": "sbx.common.policies.SimbaActor"}),
        "LayerNorm_0": (tanh, {"params": layer}),
        "mkdir": (tanh, {"params": {"log_std": Call(Path.mkdir, mark)}}),
        "size mismatch": (tanh, {"params": {"Dense_0": {"kernel": BOX.low, "bias": BOX.low}}}),
    }
    for said, (function, changed) in cases.items():
        for trust in (False, True):
            files.write("ppo", SEEN, BOX, *function, **changed)
            with pytest.raises(ValueError, match=rf"a model of sbx: .*{said}.*; name module:function") as caught:
                load_ego(files.path, trust=trust)
            assert "\n" not in str(caught.value)
    files.write("ppo", SEEN, BOX, *tanh, more=Call(Path.mkdir, mark))
    load_ego(files.path, trust=True)  # what does not act is not made
    assert not mark.exists()


@pytest.mark.parametrize("name", ["PPO", "SAC", "TQC", "TD3", "DDPG", "DQN"])
def test_it_acts_as_sbx_itself(name: str, tmp_path: Path) -> None:
    sbx = pytest.importorskip("sbx")
    env = gym.make("CartPole-v1" if name == "DQN" else "Pendulum-v1")
    few = {"n_steps": 64} if name == "PPO" else {"learning_starts": 20, "buffer_size": 500}
    model = getattr(sbx, name)("MlpPolicy", env, seed=0, **few).learn(200)
    model.save(tmp_path / "ego.zip")
    seen = np.random.default_rng(0).normal(0.0, 1.0, (500, *env.observation_space.shape)).astype(np.float32)
    ego: Any = load_ego(tmp_path / "ego.zip")
    np.testing.assert_allclose(ego.predict(seen)[0], model.predict(seen, deterministic=True)[0], atol=1e-5)
