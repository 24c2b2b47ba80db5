"""The runs, their summary and the command, on small budgets."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import benchmarks.estimators.compare_methods
from benchmarks.estimators.report import format_cells, summary
from benchmarks.estimators.runs import Job, LimitReached, Meter, MethodRun, run_all, run_once
from benchmarks.estimators.summary import cell_of, cells_of, covers, own_errors_off, power_of, verdicts, without_numbers

P = 1e-3


def made(p=P, cov=0.1, low=0.8 * P, high=1.2 * P, **changes) -> MethodRun:
    run = MethodRun("ce", "lin_d2", 0, p, low, high, cov, n_sim=1000, calls=4, seconds=0.01, status="converged")
    return replace(run, **changes)


def test_cell():
    cell = cell_of([made(0.9 * P, low=0.7 * P, high=0.95 * P), made(1.1 * P), made(1.3 * P, low=1.1 * P)], P)
    assert cell.mean_over_p == pytest.approx(1.1)
    assert cell.cov == pytest.approx(0.2 / 1.1)
    assert cell.own_over_cov == pytest.approx(0.1 / (0.2 / 1.1))
    assert cell.gain == pytest.approx(999 / (1000 * (0.01 + 0.01 + 0.09) / 3))
    assert cell.coverage == pytest.approx(1 / 3)
    assert cell.worst == pytest.approx(0.3)


def test_runs_that_raised_do_not_cover_and_count_nowhere_else():
    nan = math.nan
    lost = made(nan, nan, nan, nan, error="ValueError: no", status="raised")
    cell = cell_of([made(1.1 * P), made(0.9 * P), lost, lost], P)
    assert cell.raised == 2
    assert cell.coverage == 0.5
    assert cell.mean_over_p == pytest.approx(1.0)
    assert math.isnan(cell_of([lost, lost], P).gain)


def test_impossible_failure_has_coverage_only():
    cell = cell_of([made(0.0, math.inf, 0.0, 1e-3)] * 3, 0.0)
    assert cell.coverage == 1.0
    assert math.isnan(cell.gain)
    assert math.isnan(cell.mean_over_p)


@pytest.mark.parametrize(
    ("run", "off"),
    [
        (made(1.2 * P, 0.05), 0.2 / 0.06),
        (made(0.0, math.inf, 0.0, 2 * P), math.nan),
        (made(0.0, math.inf, 0.0, 0.5 * P), math.inf),
        (made(error="ValueError"), math.nan),
    ],
)
def test_own_errors_off(run, off):
    assert own_errors_off(run, P) == pytest.approx(off, nan_ok=True)


def test_power_of_warnings():
    p = 2.3262907903552502e-04  # of lin_d2
    right, wrong = made(p, 0.1), made(2 * p, 0.1)
    runs = [right] * 3 + [replace(right, warnings=("ESS of 3.",)), wrong]
    runs += [replace(wrong, warnings=("ESS of 12.5.", "Spent."))] * 2 + [made(1.3 * p, 0.1)]
    power = power_of(runs)
    assert (power.wrong, power.wrong_warned, power.right, power.right_warned) == (3, 2, 4, 1)
    assert power.texts == {"ESS of #.": (2, 1, 0), "Spent.": (2, 0, 0)}


def test_numbers_are_taken_out_of_warnings():
    assert without_numbers("p = 1.5e-04 of 6,000, -3 at 0.25.") == "p = # of #, # at #."


def test_targets():
    good = cell_of([made(0.98 * P, 0.03)] * 5 + [made(1.03 * P, 0.03)] * 5, P)
    nothing = power_of([])
    of_papers = verdicts([good], nothing)
    assert [verdict.met for verdict in of_papers] == [True]
    default = verdicts([replace(good, method="two-stage", gain=5000.0)], nothing)
    assert {v.target: v.met for v in default} == {
        "lin_d2: gain >= 3,000": True,
        "lin_d2: coverage >= 88%": True,
        "lin_d2: mean/p within 3 %": True,
        "lin_d2: own c.o.v. 0.8 to 1.3 of the real one": True,
        "pooled coverage >= 93%": True,
        "wrong runs warned >= 80 %": True,
        "right runs warned <= 5 %": True,
    }
    bad = replace(good, method="two-stage", gain=2000.0, mean_over_p=0.96, coverage=0.8, own_over_cov=0.5)
    assert sum(verdict.met for verdict in verdicts([bad], nothing)) == 2


def test_meter_counts_and_stops():
    meter = Meter(lambda x: x[:, 0], limit=10)
    meter(np.zeros((4, 2)))
    meter(np.zeros((6, 2)))
    assert (meter.calls, meter.points) == (2, 10)
    with pytest.raises(LimitReached, match="more than 10"):
        meter(np.zeros((1, 2)))


def test_what_a_method_raises_is_recorded(monkeypatch):
    def estimate(*args, **kwargs):
        raise ArithmeticError("singular")

    monkeypatch.setattr("samplers.estimate", estimate)
    run = run_once(Job("ce", "lin_d2", 0))
    assert run.error == "ArithmeticError: singular"
    assert math.isnan(run.p)


@pytest.mark.slow
def test_two_processes_give_the_runs_of_one():
    jobs = [Job("ss", problem, seed, 1500) for problem in ("noisy_d6", "six_d8") for seed in range(3)]
    one, two = list(run_all(jobs)), list(run_all(jobs, workers=2))
    assert [replace(run, seconds=0) for run in one] == [replace(run, seconds=0) for run in two]


def test_noise_differs_between_runs_and_comes_back_with_the_seed():
    first, again, other = (run_once(Job("adss", "noise2_d4", seed, 2000)) for seed in (1, 1, 2))
    assert replace(first, seconds=0) == replace(again, seconds=0)
    assert first.p != other.p


def test_tables():
    jobs = [Job("ce", "lin_d2", seed, 3000) for seed in range(3)]
    runs = list(run_all(jobs))
    cells = cells_of(runs)
    assert all(covers(run, 2.326e-4) for run in runs)
    text = format_cells(cells)
    assert len({line.count("|") for line in text.splitlines()}) == 1
    assert "Pooled coverage 100.0 % of 3 runs" in summary(cells, power_of(runs), verdicts(cells, power_of(runs)))


def test_command(tmp_path):
    out = tmp_path / "figures.json"
    app = benchmarks.estimators.compare_methods.typer.Typer()
    app.command()(benchmarks.estimators.compare_methods.main)
    arguments = "--runs 2 --methods adss --problems corner_d5,never_d4 --max-sim 1000 --rotation 7 --json".split()
    result = CliRunner().invoke(app, [*arguments, str(out)])
    assert result.exit_code == 0, result.output
    assert "corner_d5" in result.output
    data = json.loads(out.read_text())
    assert data["about"]["rotation"] == 7
    assert len(data["runs"]) == 4
    assert max(run["n_sim"] for run in data["runs"]) <= 1000
    unknown = CliRunner().invoke(app, ["--problems", "corner"])
    assert unknown.exit_code == 2
