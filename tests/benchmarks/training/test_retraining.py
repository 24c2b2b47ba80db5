"""The benchmark of retraining: what is trained on and held out in a round, the control, the table and the picture."""

import numpy as np
import pytest

import samplers
from benchmarks.training import retraining
from benchmarks.training.retraining import RetrainingRound, compare_arms, draw_rounds, format_rounds, run_arm


def make_round(seed=0, arm="failures", number=0, p=1e-3, **more):
    values = {"found": (p, p / 2, 2 * p), "held_out": (p, p / 2, 2 * p), "counted": (0.0, 0.0, 2e-4)}
    return RetrainingRound(
        seed, arm, number, **values, **{"simulations": 12_000, "found_failures": 1000, "held_out_failures": 900, **more}
    )


@pytest.mark.parametrize("arm", ["failures", "ordinary"])
def test_the_failures_of_all_rounds_are_trained_on_and_the_others_held_out(arm, tmp_path, monkeypatch):
    """Egos that are never trained: the scenarios that a training would get are looked at."""
    given = []

    def train(env_id, algo, steps, seed, out, retraining=None):
        given.append(None if retraining is None else retraining.failures)
        out.write_text("")
        return out

    problem = samplers.FunctionProblem(lambda u: 2.5 - u.sum(axis=1) / 6**0.5, dim=6)
    monkeypatch.setattr(retraining, "make_problem", lambda ego: problem)
    monkeypatch.setattr(retraining, "train_ego", train)
    rounds = list(run_arm(0, arm, tmp_path, rounds=2, first=10, more=10, simulations=700, counted=50))
    assert [one.round for one in rounds] == [0, 1, 2]
    assert [one.still_failing for one in rounds] == [(1.0, 1.0), (1.0, 1.0), None]  # the same ego in each round
    assert given[0] is None
    assert all(0 < one.found[0] < 0.02 and one.held_out != one.found for one in rounds)
    if arm == "ordinary":
        assert [len(x) for x in given[1:]] == [1000, 1000]
        assert not np.array_equal(given[1], given[2])
    else:
        assert [len(x) for x in given[1:]] == [rounds[0].found_failures, sum(one.found_failures for one in rounds[:2])]
        assert (problem.evaluate(given[2]) <= 0.0).all()


def test_the_table_and_the_ratio_of_the_arms(tmp_path):
    rounds = [
        make_round(0, "failures", 1, 1e-4, still_failing=(0.25, 0.5)),
        make_round(0, "ordinary", 1, 4e-4, still_failing=(0.5, 0.5)),
        make_round(1, "failures", 1, 1e-4, still_failing=None),
        make_round(1, "ordinary", 1, 1e-4, still_failing=None),
    ]
    middle, low, high = compare_arms(rounds, 1)
    half = 12.706204736 * np.log(2.0)  # Student's quantile of one degree of freedom; the logs are 0 and -log 4
    assert (middle, low, high) == pytest.approx((0.5, 0.5 * np.exp(-half), 0.5 * np.exp(half)))
    assert "| 0 | failures | 1 | 1.0e-04 (5.0e-05 to 2.0e-04) |" in format_rounds(rounds)
    assert "| 1,000, 900 | 0.250, 0.500 |" in format_rounds(rounds)
    draw_rounds(rounds, tmp_path / "retraining.png")
    assert (tmp_path / "retraining.png").stat().st_size > 5_000


def test_rounds_are_read_as_they_were_written(tmp_path, monkeypatch):
    monkeypatch.setattr(retraining, "RETRAINING_RESULT", tmp_path / "retraining.json")
    assert retraining.read_rounds() == []
    rounds = [make_round(still_failing=(0.1, 0.2)), make_round(number=1, still_failing=None)]
    retraining.write_rounds(rounds)
    assert retraining.read_rounds() == rounds
