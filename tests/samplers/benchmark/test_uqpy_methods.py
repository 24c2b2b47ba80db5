"""UQpy as a row of the benchmark, and the interval that is made of its c.o.v."""

import math
import sys
import warnings

import pytest

from samplers import FunctionProblem
from samplers.benchmark import Job, run_once
from samplers.benchmark.uqpy_methods import interval_of_cov, run_uqpy_subset


def test_the_interval_is_that_of_a_lognormal_distribution() -> None:
    """exp(1.96 sigma) with sigma^2 = ln(1 + c.o.v.^2); for a small c.o.v. 1.96 times it."""
    p, low, high, cov = interval_of_cov(1e-3, 0.5)
    assert (p, cov) == (1e-3, 0.5)
    assert math.log(high / p) == pytest.approx(1.96 * math.sqrt(math.log(1.25)), rel=1e-4)
    assert high / p == pytest.approx(p / low)
    p, low, high, _ = interval_of_cov(1e-3, 1e-3)
    assert high - low == pytest.approx(2 * 1.96e-6, rel=1e-3)


@pytest.mark.parametrize(("p", "cov"), [(0.0, 0.3), (1e-3, math.nan), (1e-3, math.inf)])
def test_without_an_error_nothing_is_excluded(p: float, cov: float) -> None:
    assert interval_of_cov(p, cov) == (p, 0.0, 1.0, math.inf)


def test_their_subset_simulation_on_a_half_space() -> None:
    pytest.importorskip("UQpy", reason="pip install rare-envs[uqpy]")
    runs = [run_once(Job("uqpy-ss", "common_d4", seed, max_sim=5000)) for seed in range(10)]
    assert {run.error for run in runs} == {""}
    assert sum(run.p for run in runs) / 10 == pytest.approx(4.02e-2, rel=0.3)
    assert sum(run.low < 4.02e-2 < run.high for run in runs) >= 7
    assert all(1000 <= run.n_sim <= 5000 for run in runs)
    again = run_once(Job("uqpy-ss", "common_d4", 0, max_sim=5000))
    assert (again.p, again.cov) == (runs[0].p, runs[0].cov)


def test_its_warning_filters_do_not_outlast_its_import() -> None:
    pytest.importorskip("UQpy", reason="pip install rare-envs[uqpy]")
    before = list(warnings.filters)
    run_uqpy_subset(FunctionProblem(lambda u: 1.0 - u[:, 0], 2), seed=0, max_sim=500)
    assert warnings.filters == before


def test_where_it_is_missing_a_line_says_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "UQpy", None)
    monkeypatch.setitem(sys.modules, "UQpy.reliability", None)
    with pytest.raises(ImportError, match=r'pip install "rare-envs\[uqpy\]"'):
        run_uqpy_subset(FunctionProblem(lambda u: u[:, 0], 2), seed=0, max_sim=500)
