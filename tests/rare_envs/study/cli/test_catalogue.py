"""The names that the command line lists."""

from __future__ import annotations

import json
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import pytest
from typer.testing import Result

import agents
import rare_envs
import samplers
from rare_envs.scenarios.registry import SCENARIOS

Cli = Callable[..., Result]


@pytest.mark.filterwarnings("ignore:.*is out of date")  # HighwayEnv keeps its old versions
def test_list_shows_what_there_is(cli: Cli) -> None:
    shown = cli("list", "all").stdout
    entries = json.loads(cli("list", "--json").stdout)
    assert list(entries["environments"]) == list(SCENARIOS)
    assert list(entries["methods"]) == list(samplers.METHODS)
    for name in (*SCENARIOS, *samplers.METHODS, "us101", "highway", "idm", "ttc", "lateral_offset"):
        assert name in shown
    for env_id, environment in entries["environments"].items():
        space = rare_envs.DrivingProblem(env_id).space
        assert environment["vehicles"] == rare_envs.parallel_env(env_id).possible_agents
        listed = environment["parameters"]
        sizes = [each["size"] for each in listed]
        assert [each["name"] for each in listed] == list(space.names[: len(listed)])
        assert set(space.names[len(listed) :]) == ({"weights", "noise"} if environment["drivers"] else set())
        assert sizes == list(space.sizes[: len(listed)])
        learned = rare_envs.DrivingProblem(env_id, drivers="mgail").space
        added = [(each["name"], each["size"]) for each in environment["of_learned_drivers"]]
        assert added == list(zip(learned.names, learned.sizes, strict=True))[len(listed) :]
        for end in ("low", "high"):
            expected = np.repeat([each[end] for each in listed], sizes).tolist()
            assert expected == getattr(space, end)[: sum(sizes)].tolist()
        assert all(each["unit"] and each["meaning"] for each in listed)
        assert environment["kinematics_id"] in gym.registry
        assert environment["kinematics_id"] in shown
    assert {"highway-v0", "merge-v0", "intersection-v0", "roundabout-v0"} <= set(entries["highway_env"])
    assert "speed (6 values)" in shown
    assert "weights (404 values), noise (1,020 values)" in " ".join(shown.split())
    for name in (*agents.files.SHIPPED_DRIVERS, "okelly2018", "lidar_ttc"):
        assert name in shown
