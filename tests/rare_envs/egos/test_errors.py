"""Errors of egos, and what is no ego."""

import subprocess
import sys
from typing import Any

import pytest

import rare_envs
from rare_envs.egos.errors import NoAnswer, check_predict, reason_of, refuse_ego


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (RuntimeError("no\n  road"), "RuntimeError: no road"),
        (ValueError("Expected this, got that."), "Expected this, got that."),
        (SystemExit(7), "SystemExit(7)"),
        (NoAnswer("within 10 s"), "NoAnswer: within 10 s"),
    ],
)
def test_reasons_are_one_line(error: BaseException, reason: str) -> None:
    assert reason_of(error) == reason


class Still:
    """A policy."""

    def predict(self, observation: Any, **_: Any) -> Any:
        return observation


class Proxy:
    """Passes all attributes of a policy on."""

    def __getattr__(self, name: str) -> Any:
        return getattr(Still(), name)


class Short:
    """As many write it; Stable-Baselines3 hands over more."""

    def predict(self, observation: Any) -> Any:
        return observation, None


def test_a_predict_of_the_observation_alone_is_refused_before_anything_is_simulated() -> None:
    for taken in (Still(), Proxy()):
        check_predict(taken)
    with pytest.raises(
        ValueError, match=r"state, episode_start, deterministic\), as .*, got predict\(observation.* of Short"
    ):
        rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=Short())


@pytest.mark.parametrize(
    ("ego", "origin", "message"),
    [
        ("imd", "", r"^Unknown ego 'imd'; expected 'idm' or an object\. .* agents\.load_ego\('imd'\)\.$"),
        ("imd", "from f()", r"^Unknown ego 'imd' from f\(\); "),
        (Still, "", r"^Expected an ego, got the class Still; make or train one"),
        (None, "", r"^Expected 'idm' or an object with a method predict\(observation, \.\.\.\), got NoneType\.$"),
    ],
)
def test_a_refusal_says_what_was_expected(ego: object, origin: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        refuse_ego(ego, origin)


def test_the_module_needs_no_torch() -> None:
    code = "import sys, rare_envs.egos.errors; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
