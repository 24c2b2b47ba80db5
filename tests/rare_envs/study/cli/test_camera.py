"""Egos that see, and weather, through the command line and its checks."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from typer.testing import Result

Cli = Callable[..., Result]
CUT_IN = "rare_envs/CutIn-v0"


def test_weather_on_the_command_line(cli: Cli, tmp_path: Path) -> None:
    out = tmp_path / "run"
    words = ["estimate", CUT_IN, "--weather", "--observation", "camera+lidar", "--method", "mc", "--max-sim", "40"]
    found = json.loads(cli(*words, "--horizon", "1", "--out", str(out), "--json").stdout)
    assert found["question"]["weather"] is True
    assert found["question"]["observation"] == "camera+lidar"
