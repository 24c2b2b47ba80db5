"""The methods against the long Monte Carlo reference in traffic (`benchmarks/results/truth.json`)."""

import pytest
from scipy import stats

import rare_envs
import samplers
from benchmarks.estimators.against_truth import compare_with_truth, read_truths
from samplers.methods import METHODS

TRUTH = [row for row in read_truths() if not row["stratum"]]


def test_the_reference_is_long_and_complete() -> None:
    assert [(row["env_id"], row["base"]) for row in TRUTH] == [
        ("rare_envs/CarFollowing-v0", "us101-gap"),
        ("rare_envs/CarFollowing-v0", "highway"),
        ("rare_envs/CutIn-v0", "us101-15-offsets"),
        ("rare_envs/CutIn-v0", "highway"),
    ]
    for row in TRUTH:
        assert row["rollouts"] >= 1e7
        assert row["p"] == row["collisions"] / row["rollouts"]
        # rare and measurable, as far as 10 million rollouts can tell
        assert 5e-5 < row["p"] < 2e-3
        if row["base"] == "highway":
            assert 1e-4 < row["p"] < 1e-3


@pytest.mark.parametrize("row", TRUTH, ids=lambda row: f"{row['env_id']}-{row['base']}")
def test_the_reference_is_what_the_simulation_gives_now(row: dict[str, float]) -> None:
    """100,000 fresh rollouts: the count is binomial with the reference's p."""
    env_id, base = str(row["env_id"]), str(row["base"])
    result = samplers.estimate(
        rare_envs.DrivingProblem(env_id, base=base), samplers.MonteCarlo(), max_sim=100_000, seed=99
    )
    hits = round(result.p * result.n_sim)
    test = stats.binomtest(hits, result.n_sim, row["p"])
    assert test.pvalue > 1e-4


@pytest.mark.parametrize("method", ["two-stage", "ce"])
def test_a_few_seeds(method: str) -> None:
    cell = compare_with_truth(TRUTH[0], method, range(6))
    # a t distribution with 5 degrees of freedom is beyond 6.9 once in a thousand times
    assert abs(cell["z"]) < 6.9
    assert 0.5 < cell["mean"] / cell["truth"] < 2.0
    assert cell["coverage"] >= 0.5  # at a true coverage of 90 % missed once in 800 times


@pytest.mark.slow
@pytest.mark.parametrize("method", [name for name in METHODS if name != "series"])  # made for many dimensions
@pytest.mark.parametrize("row", TRUTH, ids=lambda row: f"{row['env_id']}-{row['base']}")
def test_forty_seeds(row: dict[str, float], method: str) -> None:
    cell = compare_with_truth(row, method, range(1000, 1040))
    assert abs(cell["z"]) <= 3.0
    precise = cell["own_cov"] < 2 * row["standard_error"] / row["p"]  # as narrow as the reference is uncertain
    assert cell["coverage"] >= (0.6 if precise else 0.8)
