"""Egos from a function of the user: what does not serve is refused in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from agents import Ego, load_ego
from agents.python_function import call_factory


def observations(count: int = 16) -> np.ndarray:
    return np.random.default_rng(3).normal(7.0, 3.0, (count, 7)).astype(np.float32)


def one_line(caught: pytest.ExceptionInfo[Exception]) -> str:
    message = str(caught.value)
    assert "\n" not in message
    return message


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


def test_a_function_of_the_user_makes_the_ego(own_module: str) -> None:
    ego = load_ego(f"{own_module}:make")
    assert isinstance(ego, Ego)
    assert ego.predict(observations(2))[0] == [[0.0, 0.0]] * 2
    assert load_ego(f"{own_module}:make_rule_based") == "idm"
    assert load_ego(f"{own_module}:make_function").predict(observations(2))[0].tolist() == [[0.5, 0.5]] * 2


@pytest.mark.parametrize(
    ("function", "message"),
    [
        ("mak", r"has nothing called 'mak' \(did you mean 'make'\?\)\."),
        ("zzz", r"has nothing called 'zzz'\."),
        ("make_nothing", r"predict\(observation, \.\.\.\), got NoneType from 'own_egos_for_test:make_nothing'"),
        ("make_trouble", "failed to make an ego: RuntimeError: no weights"),
        ("make_exit", "failed to make an ego: SystemExit: 7"),
        ("make_array", "got ndarray from"),
        ("drive", "without arguments that returns the ego, got one that needs observation; for an ego that is a"),
    ],
)
def test_a_function_that_does_not_serve_is_refused(function: str, message: str, own_module: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_ego(f"{own_module}:{function}")
    one_line(caught)


def test_a_module_that_exits_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "script_for_test.py").write_text("import sys\nsys.exit('usage: script')\n")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"Cannot import 'script_for_test' .*SystemExit: usage: script"):
        load_ego("script_for_test:make")


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ("own", "Expected module:name for the ego 'own'"),
        (":make", "Expected module:name"),
        ("math:pi", "Expected 'math:pi' to be a function that returns an ego, got float"),
        ("no_such_module_for_test:make", "Cannot import 'no_such_module_for_test' for the ego"),
    ],
)
def test_other_specs_are_refused(spec: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        call_factory(spec)
