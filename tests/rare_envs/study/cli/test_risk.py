"""Risks and rates on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.rare_envs.study.fitted_files import write_fitted
from tests.rare_envs.study.refusals import Cli, assert_refused

FEW = ("--method", "mc", "--max-sim", 300)
BRAKE = ("estimate", "rare_envs/HardBrake-v0", *FEW)


@pytest.fixture
def bases(here: Path) -> list[str]:
    """Options that name a fitted base for each scenario."""
    names = ("cut_in", "hard_brake")
    return [word for name in names for word in ("--base", f"{name}={write_fitted(here / f'{name}.json', name)}")]


def test_the_table_and_the_folder(cli: Cli, bases: list[str], here: Path) -> None:
    result = cli("risk", "idm", *bases, *FEW, "--out", here / "out")
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith("collisions per million km  ")
    assert "cut-in        0.26 per km x " in result.stdout
    assert result.stdout.endswith(f"Wrote {here / 'out'}.\n")
    assert (here / "out" / "risk.png").exists()


def test_bad_input_is_one_line(cli: Cli, here: Path, bases: list[str]) -> None:
    for words, *said in (
        (["imd", *bases], "idm"),
        (["idm", *bases, "--with", "merge"], "cut-in or --with car-following", "'merge'"),
        (["idm", "--base", "hard_brake=us101", "--base", "hard_brake=mine.json"], "several for 'hard_brake'"),
        (["idm", *bases, "--sites", "us101-closing"], "no site", "'us101'", "cut_in=us101-closing"),
        (["idm", "--base", "cut_in=mine.json"], "mine.json"),
        (["idm", "--base", "cut_in=broken.json"], "broken.json", "JSON"),
        (["idm", "--base", "cut_in=highway"], "'highway'", "nobody counted"),
        (["idm", *bases, "--max-sim", "0"], "--max-sim"),
        (["idm", *bases, *FEW, "--out", here / "a_file"], "a_file"),
    ):
        assert_refused(cli("risk", *words), *said)


def test_estimate_prints_the_rate_beside_people(cli: Cli, here: Path) -> None:
    base = write_fitted(here / "fitted.json", "hard_brake")
    short = " ".join(cli(*BRAKE, "--base", base).stdout.split())
    assert "per million km (" in short and "; people 15 to 21 (contacts at any speed) " in short
    text = " ".join(cli(*BRAKE, "--base", base, "--details").stdout.split())
    assert "per million km (" in text
    assert (
        "people: 21 contacts of all kinds, 4.3 into a vehicle ahead (100-Car), 15 crashes without tyre strikes (SHRP 2)"
        in text
    )
    assert "from 0.19 brakings per km; the uncertainty is" in text
    data = json.loads(cli(*BRAKE, "--base", base, "--json").stdout)
    assert data["rate"]["per_hour"] == pytest.approx(42 / 5.64 * data["p"])


def test_estimate_says_in_one_line_why_there_is_no_rate(cli: Cli, here: Path) -> None:
    base = write_fitted(here / "fitted.json", "hard_brake")
    for words, said in (
        (("--base", base, "--gamma", "1"), "--gamma 1 counts other events"),
        (("--base", base, "--measure", "drac"), "--measure drac counts other events"),
        (("--base", write_fitted(here / "b.json", "hard_brake", frequency=None)), "nobody counted"),
    ):
        lines = [line for line in cli(*BRAKE, *words).stdout.splitlines() if "no rate" in line]
        assert len(lines) == 1
        assert said in lines[0]


def test_p_under_other_bases(cli: Cli, here: Path) -> None:
    """A near one is answered, a far one refused with its reason; one that is not there before any simulation."""
    base, near, far = (
        write_fitted(here / f"{name}.json", "hard_brake", shift=shift)
        for name, shift in (("own", 0.0), ("near", 0.2), ("far", 8.0))
    )
    words = (*BRAKE, "--base", base, "--also-under", f"{near}, {far}")
    answers = {Path(each["base"]).stem: each for each in json.loads(cli(*words, "--json").stdout)["other_bases"]}
    assert answers["near"]["refused"] == ""
    low, high = answers["near"]["interval"]
    assert low < answers["near"]["p"] < high
    assert "effective" in answers["far"]["refused"] or "worth" in answers["far"]["refused"]
    text = cli(*words).stdout
    assert f"under {near} " in text
    assert f"under {far} not known: " in " ".join(text.split())
    assert_refused(cli(*BRAKE, "--base", base, "--also-under", "nowhere"), "nowhere")
    assert_refused(cli(*BRAKE, "--base", base, "--also-under", ","), "one base or more")
    assert_refused(cli(*BRAKE, "--base", base, "--also-under", f"{near},{near}"), "each once")
