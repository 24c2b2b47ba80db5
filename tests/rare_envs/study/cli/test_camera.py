"""Egos that see, and weather, through the command line and its checks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from typer.testing import Result

import rare_envs
from rare_envs.study.ego_check.checks import EGO_CHECKS, Probe

Cli = Callable[..., Result]
CUT_IN = "rare_envs/CutIn-v0"
SIZE = (36, 60)


class Sees:
    """Accelerates by brightness, of pictures alone or beside lidar."""

    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, space: spaces.Space[Any]) -> None:
        self.observation_space = space

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        pictures = observation["camera"] if isinstance(observation, dict) else observation
        brightness = pictures[:, 10:20].mean(axis=(1, 2, 3)) / 255.0
        return np.stack((brightness, 0.0 * brightness), axis=1), state


@pytest.mark.parametrize("observation", ["camera", "camera+lidar"])
def test_an_ego_that_sees_is_checked(observation: str) -> None:
    settings: dict[str, Any] = {"observation": observation, "camera": SIZE, "horizon": 0.2}
    space = rare_envs.make_batch(CUT_IN, 1, **settings).single_observation_space
    ego = Sees(space)
    problem = rare_envs.DrivingProblem(CUT_IN, ego=ego, **settings)
    probe = Probe.of(ego, problem)
    findings = [finding for check in EGO_CHECKS for finding in check(probe)]
    assert len(findings) >= len(EGO_CHECKS) - 1
    assert [finding for finding in findings if finding.status != "pass"] == []


def test_weather_on_the_command_line(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["estimate", CUT_IN, "--weather", "--observation", "camera+lidar", "--method", "mc", "--max-sim", "40"]
    found = json.loads(cli(*words, "--horizon", "1", "--out", str(out), "--json").stdout)
    assert found["question"]["weather"] is True
    assert found["question"]["observation"] == "camera+lidar"
