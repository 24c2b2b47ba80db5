"""Records of runs: made once, made again where a stop has cut them off, refused where they do not belong."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from benchmarks.results_page import PAGE, format_page
from benchmarks.run_lines import RunLines
from rare_envs.study.arguments import BadInput

HEADER = {"rare_envs": "1", "scale": "small"}


def lines_of(folder: Path, **changes) -> RunLines:
    return RunLines(
        folder / "runs.jsonl", {**HEADER, **changes}, dict, dict, key_of_job=str, key_of_run=lambda run: run["key"]
    )


class Maker:
    """Makes runs and remembers for which jobs."""

    def __init__(self) -> None:
        self.made: list[str] = []

    def __call__(self, jobs):
        for job in jobs:
            self.made.append(job)
            yield {"key": job, "value": 1.0 / float(job)}


def test_a_torn_line_is_made_again_and_a_stop_keeps_what_was_made(tmp_path: Path) -> None:
    def stop(jobs):
        yield from Maker()(jobs[:1])
        raise KeyboardInterrupt

    maker = Maker()
    with pytest.raises(KeyboardInterrupt):
        lines_of(tmp_path).complete(["1", "2"], stop)
    whole = lines_of(tmp_path).complete(["1", "2"], maker, progress=True)
    assert maker.made == ["2"]
    file = tmp_path / "runs.jsonl"
    text = file.read_text()
    file.write_text(text[:-5])
    assert lines_of(tmp_path).complete(["1", "2"], maker) == whole
    assert maker.made == ["2", "2"]
    assert file.read_text() == text


def test_numbers_that_json_has_not_come_back(tmp_path: Path) -> None:
    values = {"a": math.nan, "b": math.inf, "c": -math.inf, "d": 0.1}
    lines = lines_of(tmp_path)
    lines.complete(["1"], lambda jobs: [{"key": "1", **values}])
    (run,) = lines.read()
    assert math.isnan(run["a"])
    assert (run["b"], run["c"], run["d"]) == (math.inf, -math.inf, 0.1)


def test_runs_of_something_else_and_damaged_files_are_refused_in_one_line(tmp_path: Path) -> None:
    lines_of(tmp_path).complete(["1"], Maker())
    with pytest.raises(BadInput, match="has runs of scale small, this is full: choose another --out"):
        lines_of(tmp_path, scale="full").complete(["1"], Maker())
    for text in ("x\n", "{}\n", "[]\n", '{"rare_envs": "1"}\n'):
        (tmp_path / "runs.jsonl").write_text(text)
        with pytest.raises(BadInput, match="line 1") as caught:
            lines_of(tmp_path).read()
        assert "\n" not in str(caught.value)


def test_the_page_is_what_the_records_give() -> None:
    assert PAGE.read_text(encoding="utf-8") == format_page(), "run python -m benchmarks.results_page"
    assert len(format_page().splitlines()) <= 300
