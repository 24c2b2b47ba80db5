"""The command `export`, on the folder of a small run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from tests.rare_envs.study.refusals import Cli, assert_refused


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def test_a_failure_becomes_files(cli: Cli, run: Path, tmp_path: Path) -> None:
    result = cli("export", run, "--format", "commonroad", "--out", tmp_path / "a.xml", "--json")
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["files"] == [str(tmp_path / "a.xml")] and (tmp_path / "a.xml").stat().st_size > 1000
    pytest.importorskip("scenariogeneration", reason='scenariogeneration comes with "rare-envs[export]"')
    result = cli("export", run, "--failure", 1, "--format", "carla", "--out", tmp_path / "a.xosc")
    assert result.exit_code == 0 and (tmp_path / "a.xodr").exists()
    assert result.stdout == f"Wrote {tmp_path / 'a.xosc'} and {tmp_path / 'a.xodr'}.\n"


def test_refusals_are_one_line(cli: Cli, run: Path, tmp_path: Path) -> None:
    assert_refused(cli("export", tmp_path / "none", "--out", tmp_path / "a.xosc"), "No finished run in")
    assert_refused(cli("export", run, "--out", tmp_path / "a.gif"), "ends in .xosc")
    assert_refused(cli("export", run, "--format", "carla", "--ego", "recorded", "--out", tmp_path / "a.xosc"), "free")
    assert_refused(
        cli("export", run, "--format", "commonroad", "--failure", 10_000, "--out", tmp_path / "a.xml"), "from 0 to"
    )
    (run / "result.json").write_text("[" * 100_000)
    assert_refused(cli("export", run, "--format", "commonroad", "--out", tmp_path / "a.xml"), "result.json")
