"""Runs into figures, by hand."""

import math
from dataclasses import replace

import pytest

from samplers.benchmark.runs import MethodRun
from samplers.benchmark.summary import cell_of, cells_of, own_errors_off, power_of, without_numbers

P = 2.3262907903552502e-04
"""Of lin_d2."""


def made(p=P, cov=0.1, low=0.8 * P, high=1.2 * P, **changes) -> MethodRun:
    run = MethodRun(
        method="ce",
        problem="lin_d2",
        seed=0,
        p=p,
        low=low,
        high=high,
        cov=cov,
        n_sim=1000,
        calls=4,
        seconds=0.01,
        status="converged",
    )
    return replace(run, **changes)


def test_cell():
    cell = cell_of([made(0.9 * P, low=0.7 * P, high=0.95 * P), made(1.1 * P), made(1.3 * P, low=1.1 * P)], P)
    assert cell.mean_over_p == pytest.approx(1.1)
    assert cell.cov == pytest.approx(0.2 / 1.1)
    assert cell.own_over_cov == pytest.approx(0.1 / (0.2 / 1.1))
    assert cell.gain == pytest.approx((1 - P) / P / (1000 * (0.01 + 0.01 + 0.09) / 3))
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


def test_standard_errors_are_of_the_runs_that_ended():
    """Two of four: |ratio - 1| of 0.1 and 0.3 around a mean of 1.1, spread 0.2 sqrt(2), over sqrt(2)."""
    lost = made(math.nan, math.nan, math.nan, math.nan, error="ValueError: no", status="raised")
    ended = [made(1.3 * P), made(0.9 * P)]
    assert cell_of([*ended, lost, lost], P).mean_se == pytest.approx(0.2)
    assert cell_of([*ended, lost, lost], P).gain_se == pytest.approx(cell_of(ended, P).gain_se)


def test_a_method_that_simulates_nothing_has_no_gain():
    cell = cell_of([made(1.1 * P, n_sim=0), made(0.9 * P, n_sim=0)], P)
    assert math.isnan(cell.gain)
    assert cell.mean_over_p == pytest.approx(1.0)


def test_more_stated_simulations_than_made_ones_are_not_hidden():
    runs = [made(n_sim=1000, stated=stated) for stated in (999, 1000, 1001, None)]
    assert cell_of(runs, P).hidden == 0.25


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
        (made(1.2 * P, math.nan), math.nan),
        (made(1.2 * P, math.inf), math.nan),
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


def test_intervals_wholly_below_p_are_counted():
    runs = [made(0.5 * P, low=0.3 * P, high=0.7 * P)] * 3 + [made()] + [made(2 * P, low=1.5 * P, high=3 * P)]
    cell = cell_of(runs, P)
    assert (cell.coverage, cell.below) == (0.2, 0.6)


def test_the_interval_of_a_coverage_from_a_table():
    """18 of 20: 68.30 to 98.77 % (Clopper and Pearson)."""
    cell = cell_of([made()] * 18 + [made(high=0.9 * P)] * 2, P)
    assert cell.coverage_interval == pytest.approx((0.6830, 0.9877), abs=1e-4)


def test_budgets_are_cells_of_their_own():
    cells = cells_of([replace(made(), max_sim=budget) for budget in (300, 300, 1000)])
    assert [(cell.max_sim, cell.runs) for cell in cells] == [(300, 2), (1000, 1)]
