"""The benchmark of samplers: what a run records, wrong samplers found out, right ones not accused, its tables."""

import json
import math
import os
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from benchmarks.samplers.__main__ import main
from benchmarks.samplers.fresh_states import BLIND, HELD_OUT
from benchmarks.samplers.limit_states import (
    LimitState,
    bowl,
    concave,
    corner,
    half_spaces,
    hidden_box,
    islands,
    opposite,
    ring_part,
    round_to_steps,
    strip,
)
from benchmarks.samplers.problems import find_problem
from benchmarks.samplers.public_states import PUBLIC_STATES
from benchmarks.samplers.runs import Job, find_method, map_jobs, run_once
from benchmarks.samplers.summary import cell_of, cells_of, find_faults
from rare_envs import DrivingProblem

WRONG = "tests.benchmarks.wrong_samplers"
NEAR = {
    "half-spaces": half_spaces(3, (1.0, 1.4, 2.0), (1.0, 3.0, 0.4)),
    "noise": half_spaces(4, (1.6, 1.9), noise=0.6),
    "opposite": opposite(2, 1.2, 1.5, (0.5, 10.0)),
    "stepped": round_to_steps(half_spaces(3, (1.2, 1.6))),
    "bowl": bowl(5, 1.0, 0.2),
    "concave": concave(2.5),
    "islands": islands([(1.0, 1.0, 0.0), (-1.0, 0.0, -1.0)], [0.6, 0.8]),
    "corner": corner(4, (0.5, 0.4, 0.2)),
    "strip": strip(4, beta=1.0),
    "ring": ring_part(5, p_radius=0.3, beta=0.8),
    "box": hidden_box(beta=1.5),
}


def test_probabilities_against_monte_carlo():
    """The same formulas with the failures near enough to be counted, under a rotation."""
    n = 100_000
    for name, state in NEAR.items():
        u = np.random.default_rng(1).standard_normal((n, state.dim))
        share = np.mean(state.problem(rotation=3).evaluate(u) <= 0)
        assert share == pytest.approx(state.p, abs=4 * np.sqrt(state.p / n)), name


def estimate_by_draws(f, dim, scale, n, seed):
    """Return the mean of n terms whose expectation is p, by weighted draws of N(0, scale^2 I), and its error."""
    u = scale * np.random.default_rng(seed).standard_normal((n, dim))
    log_weights = dim * np.log(scale) - 0.5 * (1 - scale**-2) * (u**2).sum(axis=1)
    terms = np.where(f(u) <= 0, np.exp(log_weights), 0.0)
    return terms.mean(), terms.std() / n**0.5


def test_public_probabilities_against_wide_draws():
    """The c.o.v. of the mean is checked to be small enough for the comparison."""
    for name, public in PUBLIC_STATES.items():
        state = public.state
        sd = 1.0 if state.p > 1e-2 else 1.05 if state.dim > 9 else 1.4 if state.dim > 4 else 2.0
        n = 400_000 if state.dim < 20 else 50_000
        mean, error = estimate_by_draws(state.f, state.dim, sd, n, 5)
        assert error < 0.1 * state.p or state.p <= 1e-6 or state.dim >= 20, name
        assert mean == pytest.approx(state.p, abs=4 * error + 4 * state.p / np.sqrt(n * state.p + 1)), name


def test_probabilities_of_fresh_states_against_draws():
    """By weighted draws, within four standard errors, or plain ones where p is large enough."""
    for make in HELD_OUT:
        state = make()
        mean, error = estimate_by_draws(state.problem().evaluate, state.dim, 1.6 if state.p > 1e-4 else 2.3, 400_000, 1)
        assert error < 0.05 * state.p, make.__name__
        assert mean == pytest.approx(state.p, abs=4 * error), make.__name__
    for make in BLIND:
        state, rng = make(), np.random.default_rng(0)
        hits = sum(int((state.f(rng.standard_normal((10_000, state.dim))) <= 0).sum()) for _ in range(4))
        assert stats.binomtest(hits, 40_000, state.p).pvalue > 1e-4, make.__name__


def test_driving_states_are_the_scenarios_in_standard_normal_space():
    state, problem = (
        find_problem("cut_in_us101_d6").make(),
        DrivingProblem("rare_envs/CutIn-v0", base="us101-15-offsets"),
    )
    u = np.random.default_rng(0).standard_normal((20, state.dim))
    np.testing.assert_array_equal(state.f(u), problem.evaluate(problem.base.from_standard_normal(u)))
    assert state.p == 234_665 / 3e8


def test_a_function_of_a_third_party_is_counted_and_read():
    run = run_once(Job(f"{WRONG}:plain", "common_d4", seed=1, max_sim=2000))
    assert (run.n_sim, run.calls, run.stated, run.error) == (2000, 1, None, "")
    assert run.low < run.p < run.high
    assert math.isnan(run.cov)


def test_noise_differs_between_runs_and_comes_back_with_the_seed():
    first, again, other = (run_once(Job("mc", "noise2_d4", seed, 2000)) for seed in (1, 1, 2))
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
    with pytest.raises(ValueError, match=r"Unknown|Cannot load") as caught:
        find(name)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_several_processes_give_the_runs_of_one_and_a_dead_one_is_told_of():
    jobs = [Job("ss", problem, seed, 1500) for problem in ("noisy_d6", "six_d8") for seed in range(3)]
    one, two = list(map_jobs(run_once, jobs)), list(map_jobs(run_once, jobs, workers=2))
    assert [replace(run, seconds=0) for run in one] == [replace(run, seconds=0) for run in two]
    with pytest.raises(ChildProcessError, match="ended in the midst of a run"):
        list(map_jobs(os._exit, [3, 3], workers=2))


def faults_of(method: str, problem: str = "common_d4", runs: int = 3, max_sim: int = 1000) -> str:
    jobs = [Job(method, problem, seed, max_sim) for seed in range(runs)]
    (cell,) = cells_of([run_once(job) for job in jobs])
    return "; ".join(find_faults(cell))


@pytest.mark.parametrize(
    ("method", "runs", "fault"),
    [
        ("low", 6, "biased: mean / p 0.79"),
        ("narrow", 60, "intervals hold p in"),
        ("hidden", 3, "states fewer simulations than it made in 100 % of the runs"),
        ("boastful", 3, "states more simulations than it made in 100 % of the runs"),
        ("spendthrift", 3, "makes 2 times the simulations of its budget"),
        ("idle", 3, "answers without a simulation in 100 % of the runs"),
        ("stubborn", 3, "the same points at every seed: 3 runs are one, whose interval holds p"),
        ("informed", 3, "p to 10 digits in every run, as no draws give it"),
        ("impossible", 4, "answers that cannot be in 100 % of the runs (p 1.7, 0 to 2, c.o.v. nan)"),
        ("leaving", 2, "raised in 2 of 2 runs (SystemExit: enough | of this)"),
    ],
)
def test_a_wrong_sampler_is_found_out(method, runs, fault):
    assert fault in faults_of(f"{WRONG}:{method}", runs=runs)


@pytest.mark.parametrize("method", ["two-stage", "adss", f"{WRONG}:plain"])
def test_right_methods_have_no_faults(method):
    assert faults_of(method, runs=10) == ""


def test_a_row_counts_misses_and_their_own_errors():
    run = replace(run_once(Job("mc", "lin_d2", 0, 100)), p=1e-3, low=0.8e-3, high=1.2e-3, cov=0.1, n_sim=1000)
    low = replace(run, p=0.5e-3, low=0.4e-3, high=0.6e-3)  # 10 of its standard errors off
    high = replace(run, p=1.25e-3, low=1.1e-3, high=1.4e-3)  # two
    nothing = replace(run, p=0.0, low=0.0, high=2e-3, cov=math.inf)
    cell = cell_of([run, low, high, nothing], LimitState(lambda u: u[:, 0], 2, 1e-3))
    assert (cell.coverage, cell.low, cell.high) == (0.5, 1, 1)
    assert cell.mean == pytest.approx((1 + 0.5 + 1.25 + 0) / 4)
    assert cell.gain == pytest.approx(999 / (1000 * (0.25 + 0.0625 + 1) / 4))
    assert cell.error_over_own == pytest.approx(math.sqrt((0 + 10**2 + 2**2) / 3))  # of the three that state one


def test_plain_draws_that_hit_seldom_or_never_are_not_called_biased():
    """20 runs of n draws, of which k hit: a Poisson number with mean 20 n p.

    Of a mean of 5 no hit comes with probability 0.7 %, of a mean of 10 three or fewer with 1 %; of a mean of 20 no hit
    comes with 2e-9, and two or fewer with 5e-7: these are faults.
    """
    one, p = run_once(Job("mc", "lin_d2", 0, 100)), find_problem("lin_d2").make().p
    for mean, hits, biased in ((5, 0, False), (10, 3, False), (20, 0, True), (20, 2, True)):
        n = round(mean / (20 * p))
        runs = [
            replace(one, p=1 / n if seed < hits else 0.0, low=0.0, high=1.0, seed=seed, n_sim=n, max_sim=n, points="")
            for seed in range(20)
        ]
        (cell,) = cells_of([replace(run, stated=n) for run in runs])
        assert any("biased" in fault for fault in find_faults(cell)) == biased


def test_the_command_prints_a_table_for_each_method_and_writes_its_figures(tmp_path, capsys):
    own = tmp_path / "mine.py"
    own.write_text("def make():\n    return {'plane_d2': (lambda u: 1.0 - u[:, 0], 2, 0.15865525393145707, 'open')}\n")
    words = ["--method", f"mc,{WRONG}:narrow", "--problems", f"common_d4,{own}:plane_d2", "--budget", "500"]
    keep = tmp_path / "runs.jsonl"
    words += ["--keep", str(keep), "--out", str(tmp_path / "figures.json")]
    main([*words, "--runs", "3"])
    first = keep.read_text()
    main([*words, "--runs", "6"])
    assert keep.read_text().startswith(first) and len(keep.read_text().splitlines()) == 1 + 6 * 4
    table = capsys.readouterr().out
    assert table.index("| common_d4 | 4 | 0.0402 |") < table.index(f"## {WRONG}:narrow, 500 simulations")
    assert "- Intervals hold p in " in table
    cells = json.loads((tmp_path / "figures.json").read_text())["rows"]
    assert [cell["runs"] for cell in cells] == [6] * 4
    with pytest.raises(SystemExit):
        main(["--set", "nothing"])


UQPY = pytest.param("uqpy-ss", marks=pytest.mark.slow)


@pytest.mark.parametrize("name", ["openturns-ss", "openturns-nais", "openturns-ce", "openturns-form", UQPY])
def test_methods_of_other_libraries_on_a_half_space(name):
    pytest.importorskip("UQpy" if name == "uqpy-ss" else "openturns")
    run = run_once(Job(name, "lin_d2", seed=3, max_sim=5000))
    assert run.error == ""
    assert run.p == pytest.approx(2.326e-4, rel=6 * run.cov)
    assert run.low < run.p < run.high
    assert 1000 <= run.n_sim <= 15_000
