"""Names that the command line lists, on one screen and in words, and the base distributions of a scenario."""

from __future__ import annotations

import json
from dataclasses import replace

import gymnasium as gym
import highway_env  # noqa: F401  (registers its ids)
import numpy as np
import pytest

import agents
import rare_envs
import samplers
from rare_envs.scenarios.hard_brake import HARD_BRAKE
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.study.cli.listing import KINDS, TITLES
from tests.rare_envs.study.fitted_files import fitted_entries
from tests.rare_envs.study.refusals import Cli, assert_refused


def test_list_shows_what_there_is(cli: Cli) -> None:
    shown = cli("list", "all").stdout
    entries = json.loads(cli("list", "--json").stdout)
    assert list(entries["environments"]) == list(SCENARIOS)
    assert list(entries["methods"]) == list(samplers.METHODS)
    for env_id, environment in entries["environments"].items():
        space = rare_envs.DrivingProblem(env_id).space
        assert environment["vehicles"] == rare_envs.parallel_env(env_id).possible_agents
        listed = environment["parameters"]
        sizes = [each["size"] for each in listed]
        assert [each["name"] for each in listed] == list(space.names[: len(listed)])
        assert set(space.names[len(listed) :]) == ({"weights", "noise"} if environment["drivers"] else set())
        learned = rare_envs.DrivingProblem(env_id, drivers="mgail").space
        added = [(each["name"], each["size"]) for each in environment["of_learned_drivers"]]
        assert added == list(zip(learned.names, learned.sizes, strict=True))[len(listed) :]
        for end in ("low", "high"):
            expected = np.repeat([each[end] for each in listed], sizes).tolist()
            assert expected == getattr(space, end)[: sum(sizes)].tolist()
        assert all(each["unit"] and each["meaning"] for each in listed)
        assert environment["kinematics_id"] in gym.registry
        assert environment["kinematics_id"] in shown
    assert all(name in gym.registry for name in entries["highway_env"])
    assert "speed (6 values)" in shown
    assert "weights (404 values), noise (1,020 values)" in " ".join(shown.split())
    for name in (*SCENARIOS, *samplers.METHODS, "us101", *agents.files.SHIPPED_DRIVERS, "okelly2018", "lidar_ttc"):
        assert name in shown


def test_all_names_fit_a_screen(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    entries, shown = json.loads(cli("list", "--json").stdout), cli("list").stdout
    assert len(shown.splitlines()) <= 24
    words = set(shown.replace(",", " ").split())
    names = [*entries["environments"], *entries["highway_env"], *(name for kind in TITLES for name in entries[kind])]
    names += [each["name"] for environment in entries["environments"].values() for each in environment["parameters"]]
    assert {word for name in names for word in name.replace(",", " ").split()} <= words
    (highway,) = (line for line in shown.splitlines() if "Highway-v0" in line)
    assert "weights, noise" in highway
    assert all("weights" not in line for line in shown.splitlines() if "CutIn" in line)


def test_one_kind_is_explained_alone(cli: Cli) -> None:
    whole = json.loads(cli("list", "all", "--json").stdout)
    for what, there, absent, keys in (
        ("egos", "rule-based driver", "lateral_offset", ["egos"]),
        ("measures", "Post-encroachment time", "rule-based driver", ["measures"]),
        ("CutIn-v0", "us101-closing", "CarFollowing", None),
        ("rare_envs/CutIn-v0", "lateral_offset", "CarFollowing", None),
        ("environments", "merge-v0", "rule-based driver", ["environments", "highway_env"]),
    ):
        shown, alone = cli("list", what).stdout, json.loads(cli("list", what, "--json").stdout)
        assert there in shown and absent not in shown
        env_id = "rare_envs/CutIn-v0"
        one = {"environments": {env_id: whole["environments"][env_id]}}
        assert alone == (one if keys is None else {key: whole[key] for key in keys})
    refused = cli("list", "egoss")
    assert_refused(refused, "did you mean 'egos'", *KINDS)


def test_bases_tell_events_site_fit_and_frequency(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    bases = {
        "us101": fitted_entries("hard_brake"),
        "plain": {**HARD_BRAKE.bases["us101-all-brakings"], "provenance": None},
    }
    monkeypatch.setitem(SCENARIOS.data, "rare_envs/HardBrake-v0", replace(HARD_BRAKE, bases=bases))
    answer = json.loads(cli("bases", "hard_brake", "--json").stdout)
    assert answer["bases"]["us101"]["fitted_to"] == "42 events of 40 scenes"
    assert answer["env_id"] == "rare_envs/HardBrake-v0"
    text = " ".join(cli("bases", "rare_envs/HardBrake-v0").stdout.split())
    assert "us101 (the default) fitted to 42 events of 40 scenes, 30 refits" in text
    assert "site site of hard_brake, 2005-06-15" in text
    assert "fit BIC 1,086.8, held-out log likelihood -14.60 per event" in text
    assert "7.4 per hour, 0.19 per km: 42 in 5.64 h (events of a test)" in text
    assert "recorded / expected TTC < 5 s 2 / 7.5" in text
    assert "plain frequency not known, no rate per hour or km: nobody counted" in text
    assert_refused(cli("bases", "merge"), "merge", "cut_in")
    assert_refused(cli("bases", "cutin"), "did you mean 'cut_in'?")
