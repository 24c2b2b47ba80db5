"""The commands of `corpus`, on the folder of a small run."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from rare_envs.study.cli.runs import FAILS
from tests.rare_envs.study.refusals import Cli, assert_refused


@pytest.fixture
def run(finished_run: Path, here: Path) -> Path:
    return Path(shutil.copytree(finished_run, here / "run"))


def test_from_a_run_to_a_regression_test(cli: Cli, run: Path) -> None:
    assert cli("corpus", "add", "run").stdout.startswith("Added 20 of 20")
    again = json.loads(cli("corpus", "add", "run", "--json").stdout)
    assert again["added"] == 0 and len(again["failures"]) == 20
    same = cli("corpus", "run", "--ego", "idm", "--junit", "out.xml", "--json")
    assert same.exit_code == FAILS
    answer = json.loads(same.stdout)
    assert (answer["passed"], answer["failed"], answer["error"]) == (0, 20, 0)
    suite = ET.parse("out.xml").getroot()[0]
    assert suite.get("failures") == "20"
    lines = cli("corpus", "run", "--ego", "egos_here:coasting").stdout.splitlines()
    assert lines[0].startswith("egos_here:coasting fails in 20 of 20 scenarios") and len(lines) == 21


def test_a_corpus_that_an_ego_passes(cli: Cli, run: Path) -> None:
    """Thresholds below any f that there is: nobody fails, though all failed once."""
    cli("corpus", "add", "run")
    from dataclasses import replace

    from rare_envs.study.corpus import read_corpus

    for stored in read_corpus(Path("corpus")):
        strict = replace(stored, world={**stored.world, "gamma": -2.0})
        Path("corpus", f"{stored.key}.json").unlink()
        Path("corpus", f"{strict.key}.json").write_text(strict.to_json())
    result = cli("corpus", "run", "--ego", "idm")
    assert result.exit_code == 0 and result.stdout.startswith("idm fails in 0 of 20 scenarios")


def test_refusals_are_one_line(cli: Cli, run: Path) -> None:
    assert_refused(cli("corpus", "run", "--ego", "idm"), "There is no corpus")
    cli("corpus", "add", "run")
    assert_refused(cli("corpus", "run", "--ego", "nowhere.zip"), "nowhere.zip")
    assert_refused(cli("corpus", "run", "--ego", "idm", "--junit", "run/result.json/a.xml"), "Cannot make the folder")
    Path("corpus", "stray.json").write_text("{}")
    assert_refused(cli("corpus", "run", "--ego", "idm"), "stray.json", "format")
