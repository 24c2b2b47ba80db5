"""Policies of other libraries: files as these write them, loaded by a function of the user, or refused in one line."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from stable_baselines3 import DQN
from torch import nn

from agents import load_ego
from agents.loading import strip_prefixes
from rare_envs import DrivingProblem, highway_env_problem
from rare_envs.egos.needs import EgoWarning, wrap_callable
from rare_envs.study.arguments import Question
from rare_envs.study.question import digest_files
from tests.test_docs import blocks

ADAPTER = """
import torch
from safetensors.torch import load_file
from torch.distributions import Normal, TanhTransform, TransformedDistribution

class Net(torch.nn.Module):
    def __init__(self, file, head="mean"):
        super().__init__()
        state = load_file(file) if file.endswith("s") else torch.load(file, weights_only=True)
        self.decoder, self.head = torch.nn.Linear(11, len(state["decoder.bias"])), head
        self.load_state_dict(state)

    def forward(self, seen):
        out = self.decoder(seen)
        pairs = {"values": (out, out[:, :1]), "normal": (Normal(out, 1.0), out[:, :1]), "deviation": (out, out)}
        squashed = TransformedDistribution(Normal(out, 1.0), [TanhTransform()])
        pairs |= {"parts": ((out,), out[:, :1])}
        pairs |= {"memory": (out, (out, out)), "list": [out, out[:, :1]], "squashed": squashed}
        return {"mean": out, **pairs, "arrays": (out.detach().numpy(), out[:, :1].detach().numpy())}[self.head]
"""


@pytest.fixture
def seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Any:
    """Observations, in the folder of the adapter."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "adapter_for_test.py").write_text(ADAPTER)
    return rng.standard_normal((7, 11)).astype(np.float32)


def write_weights(file: str, outputs: int = 2) -> nn.Module:
    network = nn.ModuleDict({"decoder": nn.Linear(11, outputs)})
    save_file(network.state_dict(), file) if file.endswith("s") else torch.save(network.state_dict(), file)
    return network["decoder"]


@pytest.mark.parametrize("file", ["ppo.cleanrl_model", "any.safetensors"])
@pytest.mark.parametrize("head", "mean values normal deviation memory parts list arrays squashed".split())
@pytest.mark.parametrize("outputs", [2, 5])
def test_weights_alone_drive_through_a_function(file: str, head: str, outputs: int, seen: Any) -> None:
    layer = write_weights(file, outputs)
    expected = seen @ layer.weight.numpy(force=True).T + layer.bias.numpy(force=True)
    with pytest.raises(ValueError, match=rf"^[^\n]*'{file}'[^\n]*module:function\?file={file} \(docs/egos\.md"):
        load_ego(file)
    ego: Any = load_ego(f"adapter_for_test:Net?file={file}&head={head}")
    if head in ("deviation", "memory", "parts", "list", "arrays", "squashed"):  # a mean may be squashed or not, say
        with pytest.raises(ValueError, match=r"^.* \(B, 1\), got (2|a Trans).* module around .*tanh.*$"):
            ego.predict(seen)
    elif outputs == 5:  # scores of discrete actions, of which the best counts
        assert ego.predict(seen)[0].tolist() == expected.argmax(1).tolist()
    else:
        np.testing.assert_allclose(ego.predict(seen)[0], expected, atol=1e-5)


@pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_an_exported_program_drives_and_a_module_without_forward_names_its_parts(seen: Any) -> None:
    agent, rows = nn.ModuleDict({"critic": nn.Linear(11, 1), "actor": nn.Linear(11, 2)}), {0: torch.export.Dim("rows")}
    expected = agent["actor"](torch.from_numpy(seen)).numpy(force=True)
    program = torch.export.export(agent["actor"], (torch.zeros(2, 11),), dynamic_shapes=(rows,))
    torch.export.save(program, "a.pt2")
    with pytest.raises(ValueError, match=r"module:function\?file=a\.pt2"):
        load_ego("a.pt2")
    exported = wrap_callable(torch.export.load("a.pt2").module())
    np.testing.assert_allclose(exported.predict(seen)[0], expected, atol=1e-6)
    one = wrap_callable(torch.export.export(agent["actor"], (torch.zeros(1, 11),)).module())
    with pytest.raises(ValueError, match=r"^Expected a program .* with a dynamic batch .*Guard failed.*$"):
        one.predict(seen)
    for layer, refused in ((nn.Dropout(0.5), True), (nn.BatchNorm1d(2), True), (nn.Dropout(0.0), False)):
        for training in (True, False):
            network = nn.Sequential(agent["actor"], layer).train(training)
            program = torch.export.export(network, (torch.zeros(2, 11),), dynamic_shapes=(rows,))
            traced = torch.jit.trace(network, torch.zeros(2, 11), check_trace=False)
            for each in (program.module(), nn.Sequential(traced)):
                with pytest.raises(ValueError, match=r"eval\(\) bef") if refused and training else nullcontext():
                    wrap_callable(each)
            scripted = wrap_callable(torch.jit.script(network))  # which knows both modes
            np.testing.assert_array_equal(scripted.predict(seen)[0], scripted.predict(seen)[0])
    for module, part in ((agent, r"the part of it that acts \(critic, actor\), or "), (nn.Module(), "")):
        with pytest.raises(ValueError, match=rf"got {type(module).__name__} without; return {part}a function from"):
            DrivingProblem("rare_envs/CutIn-v0", ego=module)
    called = type("Called", (nn.Module,), {"__call__": lambda self, shown: shown[:, :2] + 1.0})
    np.testing.assert_array_equal(wrap_callable(called()).predict(seen)[0], seen[:, :2] + 1.0)


def test_the_recipe_for_a_memory_has_the_trained_one(seen: Any) -> None:
    page = (Path(__file__).parents[2] / "docs" / "egos.md").read_text()
    code = next(block.code for block in blocks(page) if block.code.startswith("# adapter.py"))
    Path("adapter_of_page.py").write_text(code)
    lstm, encoder = nn.LSTM(128, 128), nn.Sequential(nn.Linear(11, 128), nn.GELU())
    policy = nn.ModuleDict({"encoder": encoder, "decoder": nn.Linear(128, 5), "value": nn.Linear(128, 1)})
    weights = nn.ModuleDict({"policy": policy, "lstm": lstm}).state_dict()  # of PufferLib 3's LSTMWrapper, with cell
    torch.save(weights | {f"cell.{name[:-3]}": value for name, value in lstm.state_dict().items()}, "policy.pt")
    ego, memory, shown = load_ego("adapter_of_page:Lstm?file=policy.pt"), None, torch.from_numpy(np.stack([seen] * 3))
    for row, scores in zip(shown, policy["decoder"](lstm(encoder(shown))[0]), strict=True):
        actions, memory = ego.predict(row.numpy(), memory, np.zeros(len(row), dtype=bool))
        assert actions.tolist() == scores.argmax(1).tolist()


@pytest.mark.parametrize("rows", [1, 4])
def test_a_function_that_answers_as_predict_does_is_told_of_one_output(rows: int) -> None:
    ego = wrap_callable(lambda shown: (np.zeros(len(shown), int), None))
    with pytest.raises(ValueError, match=r"got 2 outputs; put .*an object with predict"):
        ego.predict(np.zeros((rows, 11)))


@pytest.mark.parametrize("file", ["a.pt", "a.zip", "a.onnx", "a.safetensors", "there/a.pt"])
@pytest.mark.parametrize("how", ["{}", "noisy:{}", "noisy:{}?lag=1", "process:{}", "noisy:process:{}?timeout=9?lag=1"])
def test_a_function_takes_whatever_file_its_settings_name(file: str, how: str, seen: Any) -> None:
    Path("there").mkdir()
    write_weights(file)
    named = f"adapter_for_test:Net?file={file if file[1] == '.' else 'there'}"
    question = Question(env_id="", ego=how.format(named))
    assert strip_prefixes(question.ego) == named
    assert [*map(Path, digest_files(question))] == [Path("adapter_for_test.py").resolve(), Path(file)]
    Path("a.onnx.data").touch()  # where torch puts the weights of an ONNX file
    assert len(digest_files(Question(env_id="", ego="a.onnx"))) == (2 if file == "a.onnx" else 0)
    if file == "a.zip" or (file[1] == "." and "process" not in how):
        DrivingProblem("rare_envs/CutIn-v0", ego=load_ego(question.ego), drivers=named)


FEATURES = ["presence", "x", "y", "cos_h", "sin_h"]


@pytest.mark.parametrize(
    "setting",
    [
        *[{}, {"absolute": True}, {"normalize": False}, {"features": FEATURES}],
        *[{"clip": False}, {"see_behind": True}, {"order": "shuffled"}],
    ],
)
def test_other_kinematics_are_told_by_the_last_observations(setting: dict[str, Any], seen: Any) -> None:
    env = gym.make("highway-fast-v0", config={"observation": {"type": "Kinematics", **setting}})
    model = DQN("MlpPolicy", env, buffer_size=10, device="cpu")
    last = env.reset(seed=0)[0]
    if "clip" in setting:
        last[0, 1] = 1.4  # 280 m along the road
    if "see_behind" in setting:
        last[4, 1] = -0.2  # 40 m behind
    if "order" in setting:
        last[1:] = last[:0:-1].copy()
    model._last_obs = last[None]  # which training leaves there
    model.save("ego:a?b=c.zip")  # no function
    here = gym.make("rare_envs/CutIn-kinematics-v0").observation_space
    ego = load_ego("ego:a?b=c.zip")
    doubt = ego.find_normalisation_doubt(here)  # type: ignore[union-attr]
    with nullcontext() if not doubt else pytest.warns(EgoWarning, match="test it in HighwayEnv's own environment with"):
        highway_env_problem("highway-fast-v0", ego, config={"vehicles_count": 5})
    assert all(f"({key}); test it in HighwayEnv's" in doubt for key in setting) and bool(doubt) == bool(setting)
