"""The command `bench samplers`."""

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rare_envs.study.cli.app import app

SMALL = ["bench", "samplers", "--problems", "common_d4", "--runs", "2"]


def test_a_small_benchmark_is_written_and_printed_as_json(tmp_path: Path) -> None:
    out = tmp_path / "b"
    done = CliRunner().invoke(app, [*SMALL, "--method", "mc", "--budget", "1e3", "--out", str(out), "--json"])
    assert done.exit_code == 0, done.output
    (cell,) = json.loads(done.stdout)["cells"]
    assert (cell["method"], cell["max_sim"], cell["runs"]) == ("mc", 1000, 2)
    assert sorted(path.name for path in out.iterdir()) == ["benchmark.json", "leaderboard.md", "runs.jsonl"]


def test_faults_are_printed(tmp_path: Path) -> None:
    wrong = "tests.samplers.benchmark.wrong_samplers:spendthrift"
    done = CliRunner().invoke(app, [*SMALL, "--method", wrong, "--budget", "300", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "makes 2 times the simulations of its budget" in done.stdout
    assert "1 of 1 cells have faults" in done.stdout


def test_a_method_in_the_working_directory_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A console script does not have it in the path of its modules."""
    (tmp_path / "method_of_this_test.py").write_text("def guess(problem, seed, max_sim):\n    return 1e-3, 0.0, 1.0\n")
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    method = ["--method", "method_of_this_test:guess", "--budget", "300", "--out", str(tmp_path / "b")]
    done = CliRunner().invoke(app, [*SMALL, *method])
    assert done.exit_code == 0, done.output
    assert sys.path == before


@pytest.mark.parametrize("changes", [["--method", "nothing"], ["--budget", "abc"], ["--budget", "inf"], ["--set", "x"]])
def test_bad_input_is_one_line(tmp_path: Path, changes: list[str]) -> None:
    known = SMALL if "--set" not in changes else SMALL[:2]
    done = CliRunner().invoke(app, [*known, *changes, "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1
