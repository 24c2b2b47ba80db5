"""Names on one screen, and what each of them means."""

from __future__ import annotations

import json
from collections.abc import Callable

import pytest
from typer.testing import Result

from rare_envs.study.cli.listing import KINDS, TITLES, list_names, print_overview

Cli = Callable[..., Result]

pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date")  # HighwayEnv keeps its old versions


def test_all_names_fit_a_screen(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    entries = list_names()
    print_overview(entries)
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 24
    words = set(shown.replace(",", " ").split())
    names = [*entries["environments"], *entries["highway_env"], *(name for kind in TITLES for name in entries[kind])]
    assert {word for name in names for word in name.replace(",", " ").split()} <= words
    for environment in entries["environments"].values():
        assert {each["name"] for each in environment["parameters"]} <= words
    (highway,) = (line for line in shown.splitlines() if "Highway-v0" in line)
    assert "weights, noise" in highway and "idm+mobil" in words
    assert all("weights" not in line for line in shown.splitlines() if "CutIn" in line)


@pytest.mark.parametrize(
    ("what", "there", "absent"),
    [
        ("egos", "rule-based driver", "lateral_offset"),
        ("measures", "Post-encroachment time", "rule-based driver"),
        ("CutIn-v0", "lateral_offset", "CarFollowing"),
        ("rare_envs/CutIn-v0", "us101-closing", "CarFollowing"),
        ("environments", "merge-v0", "rule-based driver"),
    ],
)
def test_one_kind_is_explained(cli: Cli, what: str, there: str, absent: str) -> None:
    shown = cli("list", what).stdout
    assert there in shown and absent not in shown


def test_one_kind_alone_is_listed_as_json(cli: Cli) -> None:
    whole = json.loads(cli("list", "--json").stdout)
    assert json.loads(cli("list", "egos", "--json").stdout) == {"egos": whole["egos"]}
    env_id = "rare_envs/CutIn-v0"
    alone = json.loads(cli("list", "CutIn-v0", "--json").stdout)
    assert alone == {"environments": {env_id: whole["environments"][env_id]}}
    assert list(json.loads(cli("list", "environments", "--json").stdout)) == ["environments", "highway_env"]
    assert json.loads(cli("list", "all", "--json").stdout) == whole


def test_an_unknown_kind_is_one_line(cli: Cli) -> None:
    refused = cli("list", "egoss")
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert ", ".join(KINDS) in " ".join(cli("list", "--help").stdout.split())
    assert "did you mean 'egos'" in refused.stderr and all(kind in refused.stderr for kind in KINDS)
