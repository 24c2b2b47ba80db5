"""The commands `reproduce`."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rare_envs.study.cli.app import app

OKELLY = ["reproduce", "okelly2018"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scale", "huge"], "a scale of small, full"),
        (["--ego", "radar"], "an ego of lidar, vision"),
        (["--seed", "-1"], "a seed of 0 or more"),
        (["--at-most", "-1"], "--at-most to be 0 or more"),
        (["--at-most", "many"], "a whole number"),
        (["--workers", "0"], "workers"),
        (["--address", "auto"], "--address"),
    ],
)
def test_bad_options_are_one_line(tmp_path: Path, words: list[str], message: str) -> None:
    done = CliRunner().invoke(app, [*OKELLY, *words, "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert message in done.stderr


def test_nothing_run_is_said_to_be_so(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, [*OKELLY, "--at-most", "0", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["findings"] == []
    assert all(value["ours"] is None for table in record["tables"] for value in table["values"])
    assert "Made: 0 of" in record["notes"][1]
    assert "not run" in (tmp_path / "reproduction.html").read_text()
