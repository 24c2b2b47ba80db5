"""The command `replay`: one failure with its film, all of them, and another ego in them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from rare_envs.study.cli.runs import FAILS
from rare_envs.study.run_folder import read_failures
from rare_envs.study.video import CURVES_HEIGHT, LAST_FRAME_TICKS
from tests.rare_envs.study.refusals import Cli, assert_refused


@pytest.fixture
def run(finished_run: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def test_a_failure_of_a_run_is_shown(cli: Cli, run: Path, tmp_path: Path) -> None:
    clip = tmp_path / "clip.gif"
    result = cli("replay", run, "--failure", 1, "--out", clip, "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["f"] == answer["f_recorded"] == read_failures(run)["f"][1] == -1.0
    assert answer["crash"]["kind"] == "rear_end"
    assert answer["crash"]["vehicles"] == [0, 1]
    with Image.open(clip) as film:
        assert film.size == (800, 160 + 48 + CURVES_HEIGHT)
        length = 0
        for k in range(film.n_frames):
            film.seek(k)
            length += film.info["duration"]
    assert length == pytest.approx(1000 * answer["seconds"] + 100 * LAST_FRAME_TICKS, abs=1)  # equal frames are one
    words = cli("replay", run, "--out", tmp_path / "worst.png").stdout
    n_found = json.loads((run / "result.json").read_text())["n_failures"]
    for said in (
        f"Failure 0 of {n_found} found in ",
        "ego_speed",
        "the ego into the lead (rear_end",
        f"Wrote {tmp_path / 'worst.png'}",
    ):
        assert said in words


def test_bad_input_is_one_line(cli: Cli, run: Path) -> None:
    for words, said in (
        (["--failure", 100000], "Expected a failure from 0 to"),
        (["--failure", -1], "Expected a failure from 0 to"),
        (["--out", "clip.mp4"], "ends in .gif"),
        (["--out", run / "result.json" / "clip.gif"], "there is a file of that name"),
    ):
        result = cli("replay", run, *words)
        assert result.exit_code == 2
        assert said in result.stderr
        assert len(result.stderr.strip().splitlines()) == 1


def test_another_f_than_recorded_is_a_warning(cli: Cli, run: Path) -> None:
    result = json.loads((run / "result.json").read_text())
    result["question"]["horizon"] = 0.5  # as if the program had changed
    (run / "result.json").write_text(json.dumps(result))
    answer = cli("replay", run)
    assert answer.exit_code == 3
    assert "warning: the run recorded f = -1" in answer.stdout


@pytest.fixture
def short_run(finished_run: Path, here: Path) -> Path:
    """The same in a working directory with egos."""
    return Path(shutil.copytree(finished_run, here / "run"))


def test_all_failures_replay(cli: Cli, short_run: Path) -> None:
    answer = json.loads(cli("replay", "run", "--all", "--json").stdout)
    assert answer["same"] == len(answer["trials"]) > 20
    other = cli("replay", "run", "--all", "--ego", "egos_here:coasting", "--json")
    assert other.exit_code == FAILS and json.loads(other.stdout)["failed"] == len(answer["trials"])
    table = (short_run / "failures.csv").read_text().splitlines()
    names = table[0].split(",")
    row = table[1].split(",")
    row[names.index("f")] = "-0.5"
    (short_run / "failures.csv").write_text("\n".join([table[0], ",".join(row), *table[2:]]) + "\n")
    changed = cli("replay", "run", "--all")
    assert changed.exit_code == 3 and changed.stdout.count("\n") == 2


def test_one_failure_with_another_ego(cli: Cli, short_run: Path) -> None:
    result = cli("replay", "run", "--ego", "egos_here:coasting")
    assert result.exit_code == 0
    assert result.stdout.splitlines()[-1] == "The ego was egos_here:coasting; that of the run had f = -1."


def test_options_that_do_not_go_together_are_refused(cli: Cli, short_run: Path) -> None:
    assert_refused(cli("replay", "run", "--all", "--out", "a.gif"), "--all without --out")
    assert_refused(cli("replay", "run", "--all", "--failure", 0), "--all without --failure")
    assert_refused(cli("replay", "run", "--ego", "idm", "--failure", "9999"), "from 0 to")
