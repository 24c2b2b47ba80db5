"""Commands about a finished run: `replay`, `export`, `report` and `corpus`."""

from __future__ import annotations

import json
import shutil
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from rare_envs.study import html_report
from rare_envs.study.cli.runs import FAILS
from rare_envs.study.corpus import read_corpus
from rare_envs.study.run_folder import read_failures
from rare_envs.study.video import CURVES_HEIGHT, LAST_FRAME_TICKS
from tests.rare_envs.study.refusals import Cli, assert_refused


@pytest.fixture
def run(finished_run: Path, here: Path) -> Path:
    """The folder `run` in a working directory with egos."""
    shutil.copytree(finished_run, here / "run")
    return Path("run")


def test_a_failure_of_a_run_is_shown(cli: Cli, run: Path, tmp_path: Path) -> None:
    result = cli("replay", run, "--failure", 1, "--out", "clip.gif", "--json")
    assert result.exit_code == 0, result.stderr
    answer = json.loads(result.stdout)
    assert answer["f"] == answer["f_recorded"] == read_failures(run)["f"][1] == -1.0
    assert answer["crash"]["kind"] == "rear_end"
    assert answer["crash"]["vehicles"] == [0, 1]
    with Image.open("clip.gif") as film:
        assert film.size == (800, 160 + 48 + CURVES_HEIGHT)
        length = 0
        for k in range(film.n_frames):
            film.seek(k)
            length += film.info["duration"]
    assert length == pytest.approx(1000 * answer["seconds"] + 100 * LAST_FRAME_TICKS, abs=1)  # equal frames are one
    words = cli("replay", run, "--out", "worst.png").stdout
    n_found = json.loads((run / "result.json").read_text())["n_failures"]
    for said in (
        f"Failure 0 of {n_found} found in ",
        "ego_speed",
        "the ego into the lead (rear_end",
        "Wrote worst.png",
    ):
        assert said in words


def test_all_failures_replay_and_another_ego_takes_them(cli: Cli, run: Path) -> None:
    answer = json.loads(cli("replay", run, "--all", "--json").stdout)
    assert answer["same"] == len(answer["trials"]) > 20
    other = cli("replay", run, "--all", "--ego", "egos_here:coasting", "--json")
    assert other.exit_code == FAILS and json.loads(other.stdout)["failed"] == len(answer["trials"])
    one = cli("replay", run, "--ego", "egos_here:coasting")
    assert one.exit_code == 0
    assert one.stdout.splitlines()[-1] == "The ego was egos_here:coasting; that of the run had f = -1."
    table = (run / "failures.csv").read_text().splitlines()
    row = table[1].split(",")
    row[table[0].split(",").index("f")] = "-0.5"
    (run / "failures.csv").write_text("\n".join([table[0], ",".join(row), *table[2:]]) + "\n")
    changed = cli("replay", run, "--all")
    assert changed.exit_code == 3 and changed.stdout.count("\n") == 2


def test_another_f_than_recorded_is_a_warning(cli: Cli, run: Path) -> None:
    result = json.loads((run / "result.json").read_text())
    result["question"]["horizon"] = 0.5  # as if the program had changed
    (run / "result.json").write_text(json.dumps(result))
    answer = cli("replay", run)
    assert answer.exit_code == 3
    assert "warning: the run recorded f = -1" in answer.stdout


def test_a_failure_becomes_files_of_other_simulators(cli: Cli, run: Path) -> None:
    result = cli("export", run, "--format", "commonroad", "--out", "a.xml", "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["files"] == ["a.xml"] and Path("a.xml").stat().st_size > 1000
    pytest.importorskip("scenariogeneration", reason='scenariogeneration comes with "rare-envs[export]"')
    result = cli("export", run, "--failure", 1, "--format", "carla", "--out", "a.xosc")
    assert result.exit_code == 0 and result.stdout == "Wrote a.xosc and a.xodr.\n" and Path("a.xodr").exists()


def test_options_reach_the_report_and_the_answer_names_the_files(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[object] = []

    def write(run: Path, **options: object) -> list[Path]:
        asked.append((run, options))
        return [Path("a.html"), Path("figures/curve.pdf")]

    monkeypatch.setattr(html_report, "write_html_report", write)
    words = ("report", "run", "--out", "a.html", "--events", "e.csv", "--figures", "pdf", "--trust")
    assert json.loads(cli(*words, "--json").stdout) == {"report": "a.html", "figures": ["figures/curve.pdf"]}
    options = {"trust": True, "events": Path("e.csv"), "out": Path("a.html"), "figures": "pdf"}
    assert asked == [(Path("run"), options)]
    assert cli(*words).stdout == "Wrote a.html and 1 figures.\n"


def test_from_a_run_to_a_regression_test(cli: Cli, run: Path) -> None:
    assert cli("corpus", "add", run).stdout.startswith("Added 20 of 20")
    again = json.loads(cli("corpus", "add", run, "--json").stdout)
    assert again["added"] == 0 and len(again["failures"]) == 20
    same = cli("corpus", "run", "--ego", "idm", "--junit", "out.xml", "--json")
    assert same.exit_code == FAILS
    answer = json.loads(same.stdout)
    assert (answer["passed"], answer["failed"], answer["error"]) == (0, 20, 0)
    assert ET.parse("out.xml").getroot()[0].get("failures") == "20"
    lines = cli("corpus", "run", "--ego", "egos_here:coasting").stdout.splitlines()
    assert lines[0].startswith("egos_here:coasting fails in 20 of 20 scenarios") and len(lines) == 21
    for stored in read_corpus(Path("corpus")):  # thresholds below any f that there is
        strict = replace(stored, world={**stored.world, "gamma": -2.0})
        Path("corpus", f"{stored.key}.json").unlink()
        Path("corpus", f"{strict.key}.json").write_text(strict.to_json())
    result = cli("corpus", "run", "--ego", "idm")
    assert result.exit_code == 0 and result.stdout.startswith("idm fails in 0 of 20 scenarios")


def test_refusals_are_one_line(cli: Cli, run: Path) -> None:
    assert_refused(cli("corpus", "run", "--ego", "idm"), "There is no corpus")
    cli("corpus", "add", run)
    for words, said in (
        (("replay", run, "--failure", 100000), "Expected a failure from 0 to"),
        (("replay", run, "--failure", -1), "Expected a failure from 0 to"),
        (("replay", run, "--ego", "idm", "--failure", "9999"), "Expected a failure from 0 to"),
        (("replay", run, "--out", "clip.mp4"), "ends in .gif"),
        (("replay", run, "--out", "run/result.json/clip.gif"), "there is a file of that name"),
        (("replay", run, "--all", "--out", "a.gif"), "--all without --out"),
        (("replay", run, "--all", "--failure", 0), "--all without --failure"),
        (("report", "."), "No finished run"),
        (("export", "none", "--out", "a.xosc"), "No finished run in"),
        (("export", run, "--out", "a.gif"), "ends in .xosc"),
        (("export", run, "--format", "carla", "--ego", "recorded", "--out", "a.xosc"), "free"),
        (("export", run, "--format", "commonroad", "--failure", 10_000, "--out", "a.xml"), "from 0 to"),
        (("corpus", "run", "--ego", "nowhere.zip"), "nowhere.zip"),
        (("corpus", "run", "--ego", "idm", "--junit", "run/result.json/a.xml"), "Cannot make the folder"),
    ):
        assert_refused(cli(*words), said)
    Path("corpus", "stray.json").write_text("{}")
    assert_refused(cli("corpus", "run", "--ego", "idm"), "stray.json", "format")
    (run / "result.json").write_text("[" * 100_000)
    assert_refused(cli("export", run, "--format", "commonroad", "--out", "a.xml"), "result.json")
