"""The command `python -m benchmarks.papers`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.papers.__main__ import main
from benchmarks.papers.tian2024 import study
from tests.benchmarks.papers.tian2024.made_runs import made_run

OKELLY, TIAN = "okelly2018", "tian2024"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([OKELLY, "--scale", "huge"], "a scale of small, full"),
        ([OKELLY, "--ego", "radar"], "an ego of lidar, vision"),
        ([OKELLY, "--seed", "-1"], "a seed of 0 or more"),
        ([OKELLY, "--at-most", "-1"], "--at-most to be 0 or more"),
        ([OKELLY, "--workers", "0"], "--workers to be 1 or more"),
        ([TIAN, "--replications", "1"], "2 replications at least"),
    ],
)
def test_bad_options_are_one_line(tmp_path: Path, words: list[str], message: str, capsys) -> None:
    assert main([*words, "--out", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert len(told.strip().splitlines()) == 1
    assert message in told


def test_nothing_run_is_said_to_be_so(tmp_path: Path, capsys) -> None:
    assert main([OKELLY, "--at-most", "0", "--out", str(tmp_path), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["findings"] == []
    assert all(value["ours"] is None for table in record["tables"] for value in table["values"])
    assert "Made: 0 of" in record["notes"][1]
    assert "not run" in (tmp_path / "reproduction.md").read_text()


def test_it_goes_on_unless_told_otherwise(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys) -> None:
    seeds: list[int] = []
    monkeypatch.setattr(study, "run_replication", lambda job: (seeds.append(job.seed), made_run(job))[1])
    few = [TIAN, "--out", str(tmp_path), "--replications", "2"]
    assert main(few) == 0
    assert "IS is off by 2 to 17 %" in capsys.readouterr().out
    first = len(seeds)
    main(few)
    assert len(seeds) == first
    main([*few, "--afresh"])
    assert len(seeds) == 2 * first
    assert main([*few, "--seed", "1"]) == 2
    assert "choose another --out" in capsys.readouterr().err
