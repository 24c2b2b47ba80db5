"""Runs in a folder: resumed, refused where they do not fit, the same in any number of processes."""

from __future__ import annotations

import importlib
import json
import math
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from rare_envs.study.errors import BadInput
from rare_envs.study.sampler_benchmark.study import BenchmarkPlan, choose_problems, read_runs, run_study
from samplers.benchmark.solvers import _digest_package

PLAN = BenchmarkPlan(("mc", "adss"), ("common_d4", "never_d4"), (500,), runs=2)


def without_times(result):
    return [{**run, "seconds": 0} for run in result["runs"]]


def test_a_study_goes_on_where_it_has_ended(tmp_path: Path) -> None:
    whole = run_study(PLAN, tmp_path / "whole")
    part = tmp_path / "part"
    part.mkdir()
    lines = (tmp_path / "whole" / "runs.jsonl").read_text().splitlines()
    (part / "runs.jsonl").write_text("\n".join(lines[:4]) + "\n")
    assert without_times(run_study(PLAN, part)) == without_times(whole)
    assert len((part / "runs.jsonl").read_text().splitlines()) == len(lines) == 9
    assert json.loads((part / "benchmark.json").read_text())["about"]["plan"]["runs"] == 2
    assert (part / "leaderboard.md").read_text().startswith("# Samplers on problems")


def test_a_line_that_a_stop_has_cut_off_is_made_again(tmp_path: Path) -> None:
    whole = run_study(PLAN, tmp_path)
    file = tmp_path / "runs.jsonl"
    file.write_text(file.read_text()[:-20])
    assert without_times(run_study(PLAN, tmp_path)) == without_times(whole)


def test_an_executor_gives_the_runs_of_this_process(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        other = run_study(PLAN, tmp_path / "pool", executor=pool)
    assert without_times(other) == without_times(run_study(PLAN, tmp_path / "own"))


def test_runs_read_back_are_those_that_were_made(tmp_path: Path) -> None:
    """No failure: a c.o.v. of inf, which JSON has not."""
    run_study(PLAN, tmp_path)
    found = [run for run in read_runs(tmp_path / "runs.jsonl") if run.problem == "never_d4"]
    assert [run.cov for run in found] == [float("inf")] * 4


def test_a_study_that_ended_before_its_first_run_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rare_envs.study.sampler_benchmark.study.run_all", lambda *_: iter(interrupt, None))
        with pytest.raises(KeyboardInterrupt):
            run_study(PLAN, tmp_path)
    assert len((tmp_path / "runs.jsonl").read_text().splitlines()) == 1
    first = run_study(PLAN, tmp_path)
    assert without_times(run_study(PLAN, tmp_path)) == without_times(first)
    assert len(read_runs(tmp_path / "runs.jsonl")) == 8


def test_ends_and_errors_that_json_has_not_come_back(tmp_path: Path) -> None:
    """Infinite ends of an interval hold p when the study goes on, too; an unknown c.o.v. stays unknown."""
    plan = BenchmarkPlan((f"{__name__}:everything",), ("lin_d2",), (100,), runs=2)
    first = run_study(plan, tmp_path)
    assert [cell["coverage"] for cell in first["cells"]] == [1.0]
    assert without_times(run_study(plan, tmp_path)) == without_times(first)
    assert [cell["coverage"] for cell in run_study(plan, tmp_path)["cells"]] == [1.0]
    for run in read_runs(tmp_path / "runs.jsonl"):
        assert (run.low, run.high) == (-math.inf, math.inf)
        assert math.isnan(run.cov)
    text = (tmp_path / "runs.jsonl").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text


def everything(problem, seed, max_sim):
    """An interval that says nothing."""
    return 0.5, -math.inf, math.inf


def test_what_is_named_twice_is_run_once() -> None:
    plan = BenchmarkPlan(("mc", "mc"), ("lin_d2", "lin_d2"), (100, 100), runs=2)
    assert (plan.methods, plan.problems, plan.budgets) == (("mc",), ("lin_d2",), (100,))
    assert len(plan.jobs()) == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}\n", "line 1 is no run"),
        ('{"rare_envs": "0.0", "code": "0"}\nx\n', "line 2 is no run"),
        ("[]\n", "line 1 is no run"),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "runs.jsonl").write_text(text)
    with pytest.raises(BadInput, match=said) as caught:
        run_study(PLAN, tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "other"), [("rare_envs", "0.0.0"), ("code", "0123456789abcdef")])
def test_runs_of_another_version_or_other_code_are_refused(tmp_path: Path, name: str, other: str) -> None:
    result = run_study(PLAN, tmp_path)
    file = tmp_path / "runs.jsonl"
    head, *runs = file.read_text().splitlines()
    assert json.loads(head) == {"rare_envs": result["about"]["rare_envs"], "code": result["about"]["code"]}
    file.write_text("\n".join([json.dumps({**json.loads(head), name: other}), *runs]) + "\n")
    with pytest.raises(BadInput, match=f"runs of {name} {other}"):
        run_study(PLAN, tmp_path)


def test_runs_of_a_method_whose_code_has_changed_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder would else show the figures of the method as it was."""
    folder, text = tmp_path / "code", "def answer(problem, seed, max_sim):\n    return 0.1, 0.0, 1.0\n"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    for content in (text, text.replace("0.1", "0.2")):
        (folder / "changing_method.py").write_text(content)
        sys.modules.pop("changing_method", None)
        importlib.invalidate_caches()
        _digest_package.cache_clear()
        plan = BenchmarkPlan(("changing_method:answer", "mc"), ("lin_d2",), (100,), runs=2)
        if content == text:
            run_study(plan, tmp_path / "out")
            assert len({run["source"] for run in run_study(plan, tmp_path / "out")["runs"]}) == 2
        else:
            with pytest.raises(BadInput, match="runs of other code of changing_method:answer"):
                run_study(plan, tmp_path / "out")
    others = BenchmarkPlan(("mc",), ("lin_d2",), (100,), runs=2)  # which are as they were
    assert len(run_study(others, tmp_path / "out")["runs"]) == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"methods": ("nothing",)}, "Unknown method"),
        ({"problems": ("nothing",)}, "Unknown problem"),
        ({"methods": ()}, "at least one of each"),
        ({"runs": 1}, "2 runs"),
        ({"budgets": (0,)}, "budgets of 1 simulation"),
    ],
)
def test_plans_that_cannot_be_run_are_refused(changes, said) -> None:
    with pytest.raises(ValueError, match=said):
        BenchmarkPlan(**{"methods": ("mc",), "problems": ("lin_d2",), "budgets": (100,), **changes})


def test_sets_and_names() -> None:
    assert "lin_d500" in choose_problems(["highdim"])
    assert choose_problems(["highdim"], ["lin_d2"]) == ("lin_d2",)
    with pytest.raises(ValueError, match="Unknown set 'cars'; known: analytic, highdim, driving, public"):
        choose_problems(["cars"])
