"""Samplers that are wrong on purpose are found out, and right ones are not accused."""

import re
from dataclasses import replace

import pytest

from samplers.benchmark import Job, cells_of, find_faults, run_once
from tests.samplers.benchmark.test_summary import P, made

WRONG = "tests.samplers.benchmark.wrong_samplers"


def faults_of(method: str, problem: str = "lin_d2", runs: int = 30, max_sim: int = 3000) -> str:
    jobs = [Job(method, problem, seed, max_sim) for seed in range(runs)]
    (cell,) = cells_of([run_once(job) for job in jobs])
    return "; ".join(find_faults(cell))


def test_a_bias_of_a_fifth_is_found() -> None:
    assert "biased: mean / p 1.2" in faults_of(f"{WRONG}:biased")


def test_a_bias_of_a_fifth_downwards_is_found() -> None:
    assert re.search(r"biased: mean / p 0\.(79|8)", faults_of(f"{WRONG}:low"))


def test_intervals_of_half_the_width_are_found() -> None:
    """They hold p in 67 %: of 60 runs more than 50 do with a probability of 0.2 %, and 50 of 60 are accused."""
    assert "intervals hold p in" in faults_of(f"{WRONG}:narrow", "common_d4", runs=60)


def test_hidden_simulations_are_found() -> None:
    assert "states fewer simulations than it made in 100 % of the runs" in faults_of(f"{WRONG}:hidden", runs=3)


def test_simulations_that_nobody_saw_are_found() -> None:
    """A method that states more than the problem was asked for has them from elsewhere, or has not made them."""
    assert "states more simulations than it made in 100 % of the runs" in faults_of(f"{WRONG}:boastful", runs=3)
    assert "answers without a simulation in 100 % of the runs" in faults_of(f"{WRONG}:idle", runs=3)


def test_a_method_that_ignores_its_seed_is_found_and_its_runs_count_as_one() -> None:
    """Nothing is known of the bias and the coverage of one run, so neither is a fault."""
    found = faults_of(f"{WRONG}:stubborn", "common_d4", runs=20)
    assert found.startswith("the same points at every seed: 20 runs are one, whose interval holds p")
    assert "biased" not in found


def test_a_probability_that_was_read_is_found() -> None:
    assert faults_of(f"{WRONG}:informed", "common_d4", runs=3) == "p to 10 digits in every run, as no draws give it"


def test_answers_that_cannot_be_are_found_and_cover_nothing() -> None:
    jobs = [Job(f"{WRONG}:impossible", "common_d4", seed, 500) for seed in range(6)]
    (cell,) = cells_of([run_once(job) for job in jobs])
    assert cell.impossible == 1.0
    assert cell.coverage == 0.0
    assert find_faults(cell)[0] == "answers that cannot be in 100 % of the runs (p 1.7, 0 to 2, c.o.v. nan)"


def test_what_a_method_raises_is_said_in_one_line_even_where_it_ends_the_program() -> None:
    assert faults_of(f"{WRONG}:leaving", runs=2) == "raised in 2 of 2 runs (SystemExit: enough | of this)"
    found = faults_of(f"{WRONG}:silent", runs=2, max_sim=100)
    assert found == "raised in 2 of 2 runs (ValueError: expected p and an interval, got nan and 0 to 1)"


def test_more_simulations_than_the_budget_are_found() -> None:
    assert "makes 2 times the simulations of its budget" in faults_of(f"{WRONG}:spendthrift", runs=3)


@pytest.mark.parametrize("method", ["two-stage", "adss", f"{WRONG}:plain"])
def test_right_methods_have_no_faults(method: str) -> None:
    assert faults_of(method, "common_d4") == ""


def test_plain_draws_that_hit_seldom_or_never_are_not_called_biased() -> None:
    """20 runs of n draws, of which k hit: a Poisson number with mean 20 n p.

    Of a mean of 5 no hit comes with probability 0.7 %, of a mean of 10 three or fewer with 1 %; of a mean of 20 no hit
    comes with 2e-9, and two or fewer with 5e-7: these are faults.
    """
    for mean, hits, biased in ((5, 0, False), (10, 3, False), (20, 0, True), (20, 2, True)):
        n = round(mean / (20 * P))
        runs = [made(1 / n if seed < hits else 0.0, 1.0, 0.0, 1.0, seed=seed, n_sim=n) for seed in range(20)]
        (cell,) = cells_of(runs)
        assert any("biased" in fault for fault in find_faults(cell)) == biased


def test_few_runs_that_agree_by_chance_are_not_called_biased() -> None:
    """Two runs of 1,500 plain draws with p = 2.3e-4 hit once each with a probability of 6 %: both are 2.9 p."""
    few = [made(1 / 1500, 1.0, 0.0, 1.0, seed=seed, n_sim=1500) for seed in range(4)]
    (cell,) = cells_of(few)
    assert find_faults(cell) == ()
    near = [made((1.45 + 0.1 * (seed % 2)) * P, low=0.0, high=1.0, seed=seed) for seed in range(5)]
    (cell,) = cells_of(near)
    assert cell.mean_se == pytest.approx(0.0245, rel=0.01)  # 20 of them off: 5 runs may be 17.4
    assert "biased" in "; ".join(find_faults(cell))
    (cell,) = cells_of([replace(run, p=run.p - 0.1 * P) for run in near])  # 16
    assert find_faults(cell) == ()


def test_a_region_that_is_lost_in_every_run_is_found() -> None:
    """Half of p, with errors of 1 % of it."""
    runs = [replace(made((0.49 + 0.02 * (seed % 2)) * P), seed=seed) for seed in range(20)]
    (cell,) = cells_of(runs)
    assert "biased: mean / p 0.5" in "; ".join(find_faults(cell))


def test_a_region_that_nobody_can_know_of_is_no_fault() -> None:
    (cell,) = cells_of([replace(made(0.1 * P, 0.1, 0.08 * P, 0.12 * P), seed=seed) for seed in range(20)])
    assert len(find_faults(cell)) == 2
    assert find_faults(cell, knowable=False) == ()
