"""The commands `reproduce`."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rare_envs.study.cli.app import app
from rare_envs.study.cli.commands.reproduce import say_how_to_go_on
from rare_envs.study.reproduction.tian2024 import study
from tests.rare_envs.study.reproduction.tian2024.made_runs import made_run

OKELLY = ["reproduce", "okelly2018"]
TIAN = ["reproduce", "tian2024"]


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


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    seeds: list[int] = []
    monkeypatch.setattr(study, "run_replication", lambda job: (seeds.append(job.seed), made_run(job))[1])
    return seeds


def test_the_small_scale_writes_page_and_json(made: list[int], tmp_path: Path) -> None:
    out = tmp_path / "t"
    done = CliRunner().invoke(app, [*TIAN, "--out", str(out), "--scale", "small", "--json"])
    assert done.exit_code == 0, done.output
    record = json.loads(done.stdout)
    assert record["about"]["replications"] == 5
    assert record["command"] == "rare-envs reproduce tian2024 --replications 5 --seed 0"
    assert sorted(path.name for path in out.iterdir()) == ["reproduction.html", "reproduction.json", "runs.jsonl"]


def test_it_goes_on_unless_told_otherwise(made: list[int], tmp_path: Path) -> None:
    few = [*TIAN, "--out", str(tmp_path), "--replications", "2"]
    done = CliRunner().invoke(app, few)
    assert done.exit_code == 0, done.output
    assert "Wrote" in done.stdout
    assert "IS is off by 2 to 17 %" in done.stdout
    first = len(made)
    CliRunner().invoke(app, few)
    assert len(made) == first
    CliRunner().invoke(app, [*few, "--afresh"])
    assert len(made) == 2 * first


@pytest.mark.parametrize(
    "words", [[*TIAN, "--seed", "1"], [*TIAN, "--scale", "full"], OKELLY, [*OKELLY, "--at-most=0"]]
)
def test_a_folder_of_another_reproduction_is_refused_in_a_line(
    made: list[int], tmp_path: Path, words: list[str]
) -> None:
    assert CliRunner().invoke(app, [*TIAN, "--scale", "small", "--out", str(tmp_path)]).exit_code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    made.clear()
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert made == []
    assert f"{tmp_path} holds tian2024, replications 5, seed 0; this is" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["own.jsonl", "runs.jsonl"])
def test_runs_of_another_command_are_neither_joined_nor_deleted(made: list[int], tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text('{"rare_envs": "0.1.0"}\n')
    for words in ([*TIAN, "--afresh"], TIAN, OKELLY):
        done = CliRunner().invoke(app, [*words, "--out", str(tmp_path)])
        assert done.exit_code == 2
        assert "holds runs of another command" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "changes",
    [
        ["--replications", "1"],
        ["--scale", "huge"],
        ["--seed", "-1"],
        ["--workers", "0"],
        ["--monte-carlo-replications", "9"],
    ],
)
def test_bad_options_of_tian_are_one_line(tmp_path: Path, changes: list[str]) -> None:
    done = CliRunner().invoke(app, [*TIAN, "--out", str(tmp_path), "--scale", "small", *changes])
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = CliRunner().invoke(app, [*TIAN, "--out", str(tmp_path / "file"), "--replications", "2"])
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1


def test_an_interruption_says_how_to_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt), say_how_to_go_on(tmp_path):
        raise KeyboardInterrupt
    assert capsys.readouterr().err == f"The runs so far are in {tmp_path}; the same command goes on with them.\n"


def test_an_unknown_paper_is_one_line() -> None:
    done = CliRunner().invoke(app, ["reproduce", "nobody1999"])
    assert done.exit_code == 2
    assert len(done.stderr.strip().splitlines()) == 1
