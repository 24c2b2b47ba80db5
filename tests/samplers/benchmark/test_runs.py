"""One run, and what it records."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from samplers.benchmark.runs import Job, LimitReached, Meter, find_problem, map_jobs, run_all, run_once

WRONG = "tests.samplers.benchmark.wrong_samplers"


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

    monkeypatch.setattr("samplers.benchmark.runs.estimate", estimate)
    run = run_once(Job("ce", "lin_d2", 0))
    assert run.error == "ArithmeticError: singular"
    assert math.isnan(run.p)


@pytest.mark.slow
def test_two_processes_give_the_runs_of_one():
    jobs = [Job("ss", problem, seed, 1500) for problem in ("noisy_d6", "six_d8") for seed in range(3)]
    one, two = list(run_all(jobs)), list(run_all(jobs, workers=2))
    assert [replace(run, seconds=0) for run in one] == [replace(run, seconds=0) for run in two]


def test_jobs_of_any_kind_are_made_in_order_one_at_a_time_or_by_an_executor():
    made = []

    def once(job):
        made.append(job)
        return -job

    results = map_jobs(once, iter([3, 1, 2]))
    assert (next(results), made) == (-3, [3])  # the others only once they are wanted: a study keeps what it has
    assert (list(results), made) == ([-1, -2], [3, 1, 2])
    made.clear()
    with ThreadPoolExecutor(1) as executor:
        assert list(map_jobs(once, iter([3, 1, 2]), workers=7, executor=executor)) == [-3, -1, -2]
    assert made == [3, 1, 2]


@pytest.mark.slow
def test_jobs_are_made_in_several_processes():
    assert list(map_jobs(math.sqrt, [9.0, 1.0, 4.0], workers=2)) == [3.0, 1.0, 2.0]


def test_a_worker_that_dies_is_told_of_in_one_line():
    with pytest.raises(ChildProcessError, match="ended in the midst of a run") as caught:
        list(map_jobs(os._exit, [3, 3], workers=2))
    assert "\n" not in str(caught.value)


def test_noise_differs_between_runs_and_comes_back_with_the_seed():
    first, again, other = (run_once(Job("adss", "noise2_d4", seed, 2000)) for seed in (1, 1, 2))
    assert replace(first, seconds=0) == replace(again, seconds=0)
    assert first.p != other.p


def test_a_function_of_a_third_party_is_counted_and_read():
    run = run_once(Job(f"{WRONG}:plain", "common_d4", seed=1, max_sim=2000))
    assert (run.n_sim, run.calls, run.stated, run.error) == (2000, 1, None, "")
    assert run.low < run.p < run.high
    assert math.isnan(run.cov)


def test_a_method_that_never_ends_is_stopped_at_fifty_times_its_budget():
    run = run_once(Job(f"{WRONG}:endless", "lin_d2", seed=1, max_sim=1000))
    assert run.error == "LimitReached: more than 50,000 evaluations"
    assert run.n_sim == 50_000


def test_an_answer_of_two_numbers_is_recorded_as_an_error():
    assert "expected p, low, high and perhaps c.o.v., got 2" in run_once(Job(f"{WRONG}:wordy", "lin_d2", 0, 100)).error


def test_an_answer_that_is_no_number_is_recorded_as_an_error():
    run = run_once(Job("nan", "lin_d2", 0, 100), lambda problem, seed, max_sim: (math.nan, 0.0, 1.0))
    assert run.error == "ValueError: expected p and an interval, got nan and 0 to 1"


def test_an_unknown_problem_is_refused():
    with pytest.raises(ValueError, match=r"Unknown problem 'nothing' of samplers\.benchmark\.catalogue:PROBLEMS"):
        find_problem("nothing")
