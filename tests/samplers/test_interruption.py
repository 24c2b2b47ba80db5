"""What is known when a run is interrupted, and signals that wait for the end of a step."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator, Sequence

import numpy as np
import pytest

import samplers
from samplers.estimation import EstimationInterrupted, defer_signals
from samplers.method import Answer
from samplers.problem import FloatArray
from samplers.sample import Status


@pytest.fixture(autouse=True)
def interrupts() -> Iterator[None]:
    """SIGINT interrupts, also where the tests run in the background and ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class StopsAt:
    def __init__(self, call: int) -> None:
        self.left = call

    def __call__(self, x: FloatArray) -> FloatArray:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return 2.0 - x[:, 0]


@pytest.mark.parametrize("method", ["mc", "two-stage", "adss"])
def test_an_interrupted_estimation_has_what_it_knows(method: str) -> None:
    with pytest.raises(EstimationInterrupted, match=r"Interrupted after [\d,]+ simulations") as caught:
        samplers.estimate(samplers.FunctionProblem(StopsAt(3), 2), method, seed=1, max_sim=60_000, on_error="failure")
    known = caught.value.estimate
    assert known.status is Status.STOPPED
    assert known.n_sim > 0
    assert any("Interrupted after" in text for text in known.warnings)
    if method == "mc":  # P = 0.02275, 30,000 draws: c.o.v. 3.8 %
        assert known.n_sim == 30_000
        assert abs(known.p / 0.02275 - 1) < 5 * 0.038


def test_before_the_first_batch_there_is_nothing_to_know() -> None:
    with pytest.raises(KeyboardInterrupt) as caught:
        samplers.estimate(samplers.FunctionProblem(StopsAt(0), 2), "mc", seed=1)
    assert type(caught.value) is KeyboardInterrupt


def test_a_signal_while_the_method_computes_waits_until_it_can_conclude(monkeypatch: pytest.MonkeyPatch) -> None:
    take = samplers.Run.answer

    def answer(self: samplers.Run, answers: Sequence[Answer]) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        take(self, answers)

    monkeypatch.setattr(samplers.Run, "answer", answer)
    with pytest.raises(EstimationInterrupted) as caught:
        samplers.estimate(samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], 2), "mc", seed=1, max_sim=20_000)
    assert caught.value.estimate.n_sim == 10_000
    assert caught.value.estimate.p > 0


def test_the_second_signal_does_not_wait_and_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    steps = []
    with pytest.raises(KeyboardInterrupt), defer_signals():
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("after the first")
        os.kill(os.getpid(), signal.SIGINT)
        steps.append("after the second")
    assert steps == ["after the first"]
    assert signal.getsignal(signal.SIGINT) is before


def test_other_threads_estimate_without_touching_signals() -> None:
    results: list[samplers.Estimate] = []

    def work() -> None:
        problem = samplers.FunctionProblem(lambda x: 2.0 - x[:, 0], 2)
        results.append(samplers.estimate(problem, "mc", seed=1, max_sim=1000))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert np.isfinite(results[0].p)
