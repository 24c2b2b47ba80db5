"""OpenTURNS as rows of the benchmark."""

import math
import signal

import numpy as np
import pytest

pytest.importorskip("openturns")

from samplers.benchmark import Job, run_once
from samplers.benchmark.openturns_methods import ALGORITHMS, OPENTURNS, run_algorithm


@pytest.mark.parametrize("name", OPENTURNS)
def test_their_methods_on_a_half_space(name) -> None:
    run = run_once(Job(name, "lin_d2", seed=3, max_sim=5000))
    assert run.error == ""
    assert run.p == pytest.approx(2.326e-4, rel=6 * run.cov)
    assert run.low < run.p < run.high
    assert 1000 <= run.n_sim <= 15_000


@pytest.mark.parametrize("stop", [KeyboardInterrupt, SystemExit])
def test_an_interruption_stops_the_benchmark_and_is_no_error_of_the_method(stop) -> None:
    def f(u):
        raise stop

    from samplers import FunctionProblem

    with pytest.raises(stop):
        OPENTURNS["openturns-ss"](FunctionProblem(f, 2), seed=0, max_sim=1000)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_between_calls_of_f_stops_the_benchmark_too(number) -> None:
    """It arrives when f has returned, in the code that hands its values over."""

    class Late(np.ndarray):
        def __getitem__(self, key):
            signal.raise_signal(number)
            return super().__getitem__(key)

    def end(*_):
        raise KeyboardInterrupt

    before = signal.signal(number, end)
    try:
        with pytest.raises(KeyboardInterrupt):
            run_algorithm(ALGORITHMS["openturns-ss"], lambda u: (3 - u[:, 0]).view(Late), dim=2, seed=0, points=200)
        assert signal.getsignal(number) is end
    finally:
        signal.signal(number, before)


def test_an_error_of_f_is_one_line() -> None:
    def f(u):
        raise ValueError("singular")

    from samplers import FunctionProblem

    with pytest.raises(RuntimeError, match="singular"):
        OPENTURNS["openturns-ss"](FunctionProblem(f, 2), seed=0, max_sim=1000)


def test_without_a_failure_the_interval_is_the_point_that_openturns_states() -> None:
    """Its standard deviation is -1 there, and its confidence length 0: the interval is no reversed one."""
    run = run_once(Job("openturns-form", "never_d4", seed=0, max_sim=300))
    assert (run.p, run.low, run.high, run.cov, run.error) == (0.0, 0.0, 0.0, math.inf, "")
