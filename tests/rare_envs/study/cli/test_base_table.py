"""List of the base distributions of a scenario."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from rare_envs.scenarios.hard_brake import HARD_BRAKE
from rare_envs.scenarios.registry import SCENARIOS
from rare_envs.study.cli.listing import list_bases, print_bases
from tests.rare_envs.study.fitted_files import fitted_entries
from tests.rare_envs.study.refusals import Cli, assert_refused


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    bases = {
        "us101": fitted_entries("hard_brake"),
        "plain": {**HARD_BRAKE.bases["us101-all-brakings"], "provenance": None},
    }
    monkeypatch.setitem(SCENARIOS._entries, "rare_envs/HardBrake-v0", replace(HARD_BRAKE, bases=bases))


def test_the_table_for_people(fitted: None, capsys: pytest.CaptureFixture[str]) -> None:
    print_bases("rare_envs/HardBrake-v0", list_bases("rare_envs/HardBrake-v0"))
    text = " ".join(capsys.readouterr().out.split())
    assert "us101 (the default) fitted to 42 events of 40 scenes, 30 refits" in text
    assert "site site of hard_brake, 2005-06-15" in text
    assert "fit BIC 1,086.8, held-out log likelihood -14.60 per event" in text
    assert "7.4 per hour, 0.19 per km: 42 in 5.64 h (events of a test)" in text
    assert "recorded / expected TTC < 5 s 2 / 7.5" in text
    assert "plain frequency not known, no rate per hour or km: nobody counted" in text


def test_the_command(cli: Cli, fitted: None) -> None:
    answer = json.loads(cli("bases", "hard_brake", "--json").stdout)
    assert answer["bases"]["us101"]["fitted_to"] == "42 events of 40 scenes"
    assert answer["env_id"] == "rare_envs/HardBrake-v0"
    assert "42 events of 40 scenes" in cli("bases", "hard_brake").stdout


def test_unknown_scenarios_are_refused(cli: Cli) -> None:
    assert_refused(cli("bases", "merge"), "merge", "cut_in")
    assert_refused(cli("bases", "cutin"), "did you mean 'cut_in'?")
