"""Egos by name, file, address or function: what serves, and one line for what does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from agents import LearnedEgo, Provenance, load_driver, load_ego, save_driver
from agents.loading import find_ego_kind
from rare_envs import IDM
from rare_envs.control.human_driver import HumanDriverModel
from rare_envs.egos.human import HumanEgo


def one_line(caught: pytest.ExceptionInfo[Exception]) -> str:
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_learned_drivers_are_egos_by_name_and_by_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mgail", "idm"):
        (tmp_path / name).write_text("a file of that name does not matter")
    assert load_ego("idm") == "idm"
    by_name = load_ego("mgail")
    assert isinstance(by_name, LearnedEgo)
    assert by_name.driver.name == load_driver("mgail").name
    provenance = Provenance(kind="test", command="none", data="none", data_licence="none")
    save_driver(by_name.driver, provenance, tmp_path / "own.safetensors")
    by_file = load_ego("own.safetensors")
    assert isinstance(by_file, LearnedEgo)
    features = torch.randn(3, 2, 51)
    torch.testing.assert_close(by_file.driver.act(features)[0], by_name.driver.act(features)[0])
    with pytest.raises(FileNotFoundError, match=r"in that folder: own\.safetensors"):
        load_ego("owm.safetensors")
    with pytest.raises(ValueError, match=r"algo for a Stable-Baselines3 \.zip only, got 'ppo' for 'mgail'"):
        load_ego("mgail", algo="ppo")


UNKNOWN = {
    "idn": r"Unknown ego 'idn' \(did you mean 'idm'\?\); expected 'idm', 'human', .*'imitation', 'vision',",
    "": "Unknown ego ''; expected",
    "IDM": r"Unknown ego 'IDM' \(did you mean 'idm'\?\)",
    "human:no-headway": r"Unknown ego 'human:no-headway' \(did you mean 'human:no-headway-rule'\?\)",
    "runs/ego": r"Unknown ego 'runs/ego' \(there is no such file\)",
    "ego.pt": r"Unknown ego 'ego\.pt' \(there is no such file\)",
    "noisy:": "Expected an ego behind 'noisy:', such as noisy:model.zip, got 'noisy:'",
    "noisy:?latency=0.1": "Expected an ego behind 'noisy:'",
    "process:": "Expected an ego behind 'process:'",
    "math:pi": r"Expected 'idm' or an object with a method predict\(observation, ...\), got float from 'math:pi'",
    "no_such_module:make": "Cannot import 'no_such_module'",
    "https://example.org/ego.zip": r"Will not load an ego from 'https://example\.org/ego\.zip': download",
    "idm?headway=2": r"Unknown setting 'headway' \(did you mean 'time_headway'\?\); expected desired_speed",
    "idm?time_headway=long": "time_headway to be a finite number >= 0, got 'long'",
    "idm?time_headway=-1": "time_headway to be a finite number >= 0, got '-1'",
    "idm?time_headway=nan": "time_headway to be a finite number",
    "idm?time_headway=1&time_headway=2": "time_headway once",
    "human:no-headway-rule?glanc=1": "Unknown setting 'glanc' .did you mean 'glances'",
    "human?glances=2": "glances to be 1",
    "idm?time_headway": "time_headway to be a finite number >= 0, got ''",
    "noisy:idm?latncy=0.3": "Unknown setting 'latncy' .did you mean 'latency'",
    "noisy:idm?latency=soon": "Expected latency to be a finite number >= 0, got 'soon'",
    "noisy:idm?missed=1": "missed below 1",
    "noisy:idm?lag=-1": "Expected lag to be a finite number >= 0",
    "a:b?file=a&file=b": "^Expected settings as name=value, each name once, got 'file' 'b'",
    "noisy:a:b?file=": "^Expected settings .* got 'file' ''",
    "noisy:idn": "Unknown ego 'idn'",
}
"""Names and settings that cannot be used, and what is said."""


@pytest.mark.parametrize("spec", UNKNOWN)
def test_an_unknown_spec_is_refused(spec: str) -> None:
    with pytest.raises(ValueError, match=UNKNOWN[spec]) as caught:
        load_ego(spec)
    one_line(caught)


def test_what_stands_beside_a_missing_file_is_named(tmp_path: Path) -> None:
    for other in ("ego.zip", "a.onnx", "b.onnx", "c.onnx", "d.onnx"):
        (tmp_path / other).touch()
    for name, hint in (
        ("eg.zip", "; in that folder: ego.zip."),
        ("policy_of_the_third_training.onnx", "; in that folder: a.onnx, b.onnx, c.onnx."),
        ("there/ego.zip", "there' does not exist."),
        ("ego.safetensors", "has no .safetensors."),
    ):
        with pytest.raises(FileNotFoundError) as caught:
            load_ego(tmp_path / name)
        assert one_line(caught).endswith(hint)


def test_what_is_near_an_incomplete_name_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"Unknown ego .* \(a folder without egos\)"):
        load_ego(tmp_path)
    (tmp_path / "best.zip").touch()
    with pytest.raises(ValueError, match=r"did you mean '.*best\.zip'"):
        load_ego(tmp_path / "best")
    with pytest.raises(ValueError, match=r"\(a folder; name a file in it: best\.zip\)"):
        load_ego(tmp_path)


# --- settings in a name -------------------------------------------------------------------------


def test_rule_based_egos_with_settings_are_those_drivers() -> None:
    assert load_ego("idm?time_headway=2&desired_speed=30") == IDM(time_headway=2.0, desired_speed=30.0)
    assert load_ego("human?noticing_time=0") == HumanEgo(HumanDriverModel(noticing_time=0.0))
    careless = HumanDriverModel(headway_rule=False, glance_eccentricity=60.0)
    assert load_ego("human:no-headway-rule?glance_eccentricity=60") == HumanEgo(careless)
    assert load_ego("human:no-headway-rule") == "human:no-headway-rule"
    assert [find_ego_kind(f"{kind}:mine.safetensors") for kind in ("noisy", "process")] == ["noisy", "process"]
    noisy = load_ego("noisy:idm?time_headway=2?latency=0.3")
    assert (noisy.ego, noisy.stack.latency) == (IDM(time_headway=2.0), 0.3)  # type: ignore[union-attr]


# --- functions of the user ----------------------------------------------------------------------


@pytest.fixture
def own_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module of the user in the working directory; its name."""
    (tmp_path / "own_egos_for_test.py").write_text(
        "import sys\n"
        "import numpy as np\n"
        "class Straight:\n"
        "    def predict(self, observation, state=None, episode_start=None, deterministic=True):\n"
        "        return [[0.0, 0.0]] * len(observation), state\n"
        "def make():\n    return Straight()\n"
        "def make_rule_based():\n    return 'idm'\n"
        "def make_nothing():\n    return None\n"
        "def make_trouble():\n    raise RuntimeError('no\\nweights')\n"
        "def make_exit():\n    sys.exit(7)\n"
        "def make_function():\n    return lambda observation: np.full((len(observation), 2), 0.5)\n"
        "def make_array():\n    return np.zeros(2)\n"
        "def drive(observation, *rest, scale=1.0, **more):\n    return observation[:, :2]\n"
    )
    monkeypatch.chdir(tmp_path)
    return "own_egos_for_test"


def test_a_function_or_module_that_does_not_serve_is_refused(own_module: str) -> None:
    assert load_ego(f"{own_module}:make_rule_based") == "idm"
    assert load_ego(f"{own_module}:make_function").predict(np.zeros((2, 7), np.float32))[0].tolist() == [[0.5, 0.5]] * 2
    for function, message in (
        ("make_nothing", r"predict\(observation, \.\.\.\), got NoneType from 'own_egos_for_test:make_nothing'"),
        ("make_trouble", "failed to make the ego: RuntimeError: no weights"),
        ("make_exit", "failed to make the ego: SystemExit: 7"),
        ("make?file=a.pt", r"called with file='a\.pt', failed to make the ego: TypeError"),
        ("make_array", "got ndarray from"),
        ("drive", "called without arguments, failed to make the ego: TypeError: .*missing 1 required .*'observation'"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            load_ego(f"{own_module}:{function}")
        one_line(caught)
