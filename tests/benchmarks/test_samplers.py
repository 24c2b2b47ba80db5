"""The benchmark of samplers: what a run records, wrong samplers found out, right ones not accused, its tables."""

import json
import math
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.samplers.__main__ import main
from benchmarks.samplers.limit_states import (
    LimitState,
    concave,
    corner,
    half_spaces,
    hidden_box,
    islands,
    opposite,
    ring_part,
    strip,
)
from benchmarks.samplers.problems import PROBLEMS, find_problem, limit_state
from benchmarks.samplers.runs import Job, find_method, map_jobs, run_once
from benchmarks.samplers.summary import cell_of, cells_of

WRONG = "tests.benchmarks.wrong_samplers"
NEAR = {
    "half-spaces": half_spaces(3, (1.0, 1.4, 2.0), (1.0, 3.0, 0.4)),
    "noise": half_spaces(4, (1.6, 1.9), noise=0.6),
    "opposite": opposite(2, 1.2, 1.5, (0.5, 10.0)),
    "concave": concave(2.5),
    "islands": islands([(1.0, 1.0, 0.0), (-1.0, 0.0, -1.0)], [0.6, 0.8]),
    "corner": corner(4, (0.5, 0.4, 0.2)),
    "strip": strip(4, beta=1.0),
    "ring": ring_part(5, p_radius=0.3, beta=0.8),
    "box": hidden_box(beta=1.5),
}
WIDE = {
    "rare9_d8": ([0, 1, 2, 3, 4], 2.5),
    "saddle_d10": ([0, 1, 2], 2.5),
    "screen_d40": ([7, 19, 33], 2.0),
    "cones_d13": ([0, 1], 2.0),
    "frame_d120": (list(range(20, 75)), 1.15),
    "screen_d64": ([5, 23, 41, 58], 2.0),
    "rare_d14": ([0, 1, 2, 3, 4], 3.0),
    "cubic_d5": ([0, 1, 2, 3, 4], 1.8),
}
"""Coordinates along which failures are far out, and a standard deviation of draws that reaches them."""


def test_probabilities_against_monte_carlo():
    """The same formulas with the failures near enough to be counted, under a rotation."""
    n = 100_000
    for name, state in NEAR.items():
        u = np.random.default_rng(1).standard_normal((n, state.dim))
        share = np.mean(state.problem(rotation=3).evaluate(u) <= 0)
        assert share == pytest.approx(state.p, abs=4 * np.sqrt(state.p / n)), name


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, each in PROBLEMS.items() if each.group in ("visible", "fourth")][25:])
def test_probabilities_against_draws_that_reach_the_failures(name):
    """Plain draws, or wide ones along some axes, a fifth of them plain; the mean's error is checked to be small."""
    state, rng, n = limit_state(name), np.random.default_rng(1), 50_000
    wide, scale = WIDE.get(name, ([], 1.0))
    total, squares = 0.0, 0.0
    for _ in range(20):
        u = rng.standard_normal((n, state.dim))
        u[n // 5 :, wide] *= scale
        squared = (u[:, wide] ** 2).sum(axis=1)
        ratio = 0.2 + 0.8 * np.exp(0.5 * (1 - scale**-2) * squared - len(wide) * math.log(scale))
        terms = (state.problem(noise_seed=1).evaluate(u) <= 0) / ratio
        total, squares = total + terms.sum() / (20 * n), squares + (terms**2).sum() / (20 * n)
    error = math.hypot(math.sqrt((squares - total**2) / (20 * n)), state.standard_error)
    assert error < 0.12 * state.p
    assert total == pytest.approx(state.p, abs=4 * error)


def test_a_function_of_a_third_party_is_counted_and_read():
    run = run_once(Job(f"{WRONG}:plain", "common_d4", seed=1, max_sim=2000))
    assert (run.n_sim, run.calls, run.stated, run.error) == (2000, 1, None, "")
    assert run.low < run.p < run.high
    assert math.isnan(run.cov)


def test_noise_differs_between_runs_and_comes_back_with_the_seed():
    first, again, other = (run_once(Job("mc", "noisy_d17", seed, 2000)) for seed in (1, 1, 2))
    assert replace(first, seconds=0) == replace(again, seconds=0)
    assert first.points != other.points


@pytest.mark.parametrize(
    ("method", "error"),
    [
        ("endless", "LimitReached: more than 5,000 evaluations"),
        ("wordy", "TypeError: expected p, low, high and perhaps c.o.v., got 2 numbers"),
        ("leaving", "SystemExit: enough | of\nthis"),
    ],
)
def test_what_a_method_does_wrong_ends_no_benchmark(method, error):
    assert run_once(Job(f"{WRONG}:{method}", "lin_d2", seed=1, max_sim=100)).error == error


@pytest.mark.parametrize(
    ("find", "name"), [(find_problem, "nothing"), (find_method, "nothing"), (find_method, "math:nothing")]
)
def test_an_unknown_name_is_refused_in_one_line(find, name):
    with pytest.raises(ValueError, match=r"Unknown|nothing called") as caught:
        find(name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_several_processes_give_the_runs_of_one_and_a_dead_one_is_told_of():
    jobs = [Job("ss", problem, seed, 1500) for problem in ("noisy_d6", "six_d8") for seed in range(3)]
    one, two = list(map_jobs(run_once, jobs)), list(map_jobs(run_once, jobs, workers=2))
    assert [replace(run, seconds=0) for run in one] == [replace(run, seconds=0) for run in two]
    with pytest.raises(ChildProcessError, match="ended in the midst of a run"):
        list(map_jobs(os._exit, [3, 3], workers=2))


def faults_of(method: str, runs: int) -> str:
    (cell,) = cells_of([run_once(Job(method, "common_d4", seed, 1000)) for seed in range(runs)])
    return "; ".join(cell.faults)


@pytest.mark.parametrize(
    ("method", "runs", "fault"),
    [
        ("narrow", 60, "intervals hold p in"),
        ("hidden", 3, "states another number of simulations than it made"),
        ("spendthrift", 3, "makes 2 times the simulations of its budget"),
        ("stubborn", 3, "the same points at every seed"),
        ("impossible", 4, "answers that cannot be in 4 of 4 runs (p 1.7, 0 to 2, c.o.v. nan)"),
        ("leaving", 2, "raised in 2 of 2 runs (SystemExit: enough | of this)"),
    ],
)
def test_a_wrong_sampler_is_found_out(method, runs, fault):
    assert fault in faults_of(f"{WRONG}:{method}", runs)


@pytest.mark.parametrize("method", ["two-stage", "adss", f"{WRONG}:plain"])
def test_right_methods_have_no_faults(method):
    assert faults_of(method, runs=10) == ""


def test_a_row_counts_misses_and_their_own_errors():
    run = replace(run_once(Job("mc", "lin_d2", 0, 100)), p=1e-3, low=0.8e-3, high=1.2e-3, cov=0.1, n_sim=1000)
    run = replace(run, warnings=())
    low = replace(run, p=0.5e-3, low=0.4e-3, high=0.6e-3)  # 10 of its standard errors off
    high = replace(run, p=1.25e-3, low=1.1e-3, high=1.4e-3)  # two
    nothing = replace(run, p=0.0, low=0.0, high=2e-3, cov=math.inf, warnings=("no failure",))
    cell = cell_of([run, replace(low, warnings=("coarse",)), high, nothing], LimitState(lambda u: u[:, 0], 2, 1e-3))
    assert (cell.covered.count, cell.covered.of, cell.low, cell.high) == (2, 4, 1, 1)
    shares = cell.far_warned, cell.wrong_warned, cell.right_warned
    assert [(share.count, share.of) for share in shares] == [(1, 1), (1, 2), (1, 2)]
    assert cell.wrong_warned.interval == pytest.approx((0.0126, 0.9874), abs=1e-4)  # Clopper and Pearson, 1 of 2
    assert cell.mean == pytest.approx((1 + 0.5 + 1.25 + 0) / 4)
    assert cell.gain == pytest.approx(999 / (1000 * (0.25 + 0.0625 + 1) / 4))
    assert cell.error_over_own == pytest.approx(math.sqrt((0 + 10**2 + 2**2) / 3))  # of the three that state one


def test_the_command_prints_methods_side_by_side_and_writes_their_figures(tmp_path, capsys):
    """Of two methods one is plain, the other has fixed narrow intervals around p: its gain is printed bold."""
    own = tmp_path / "mine.py"
    own.write_text("def make():\n    return {'plane_d2': (lambda u: 1.0 - u[:, 0], 2, 0.15865525393145707, 'open')}\n")
    words = ["--method", f"mc,{WRONG}:informed", "--problems", f"common_d4,{own}:plane_d2", "--budget", "500"]
    keep = tmp_path / "runs.jsonl"
    words += ["--keep", str(keep), "--out", str(tmp_path / "figures.json"), "--detail"]
    main([*words, "--runs", "3"])
    first = keep.read_text()
    main([*words, "--runs", "6"])
    assert keep.read_text().startswith(first) and len(keep.read_text().splitlines()) == 1 + 6 * 4
    table = capsys.readouterr().out
    assert "| mc | 2 | " in table and " % of 12 (" in table
    rows = re.findall(r"\| common_d4 \| 4 \| 0.04 \| \S+ \(\d+\) \| (\S+) \(100\) \|", table)
    assert len(rows) == 2 and all(row.startswith("**") for row in rows)
    record = json.loads((tmp_path / "figures.json").read_text())
    assert [cell["runs"] for cell in record["cells"]] == [6] * 4
    assert {row["set"] for row in record["summaries"]} == {"visible", str(own), "all"}
    with pytest.raises(SystemExit):
        main(["--set", "nothing"])


@pytest.mark.parametrize("name", ["openturns-ss", "openturns-nais", "openturns-form", "openturns-directional"])
def test_methods_of_other_libraries_on_a_half_space(name):
    pytest.importorskip("openturns")
    run = run_once(Job(name, "lin_d2", seed=3, max_sim=5000))
    assert run.error == ""
    assert run.p == pytest.approx(2.326e-4, rel=6 * run.cov)
    assert run.low < run.p < run.high
    assert 1000 <= run.n_sim <= 15_000
