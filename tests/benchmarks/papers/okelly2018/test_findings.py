"""Statements of the paper, tested on hand-made runs."""

import numpy as np
import pytest

from benchmarks.papers.okelly2018.findings import (
    PaperClaim,
    bootstrap_ratio,
    compare_means,
    compare_starts,
    difference_interval,
    distance_beside,
    is_boxed_in,
    speed_behind,
    spread_of_starts,
)


def columns_of(n: int, rng: np.random.Generator, faster: float = 1.0, spread: float = 1.0) -> dict[str, np.ndarray]:
    """Return starts in which those behind are faster, and all values closer to their middle."""
    s = 100.0 + 8.0 * spread * rng.normal(size=(n, 6))
    speed = 15.0 + 2.0 * spread * rng.normal(size=(n, 6))
    return {
        "s": s,
        "t": 0.1 * spread * rng.normal(size=(n, 6)),
        "heading": spread * rng.normal(size=(n, 6)),
        "speed": np.where(s < s[:, :1], faster * speed, speed),
    }


def test_values_of_a_run() -> None:
    s = np.array([[100.0, 90.0, 95.0, 112.0, 130.0, 100.0]])
    speed = np.array([[15.0, 20.0, 10.0, 99.0, 99.0, 99.0]])
    columns = {"s": s, "speed": speed}
    assert speed_behind(columns).tolist() == [15.0]
    assert distance_beside(columns).tolist() == [8.5]
    assert is_boxed_in(columns).tolist() == [0.0]
    assert is_boxed_in({"s": s - 3.0 * (np.arange(6) == 3)}).tolist() == [1.0]


def test_nobody_behind_is_no_speed() -> None:
    columns = {"s": np.array([[90.0, 91.0, 92.0, 93.0, 94.0, 95.0]]), "speed": np.full((1, 6), 15.0)}
    assert np.isnan(speed_behind(columns)).all()


def test_spread_is_1_for_the_base_and_a_quarter_for_half_the_deviation() -> None:
    rng = np.random.default_rng(0)
    base = columns_of(4000, rng)
    assert spread_of_starts(base, base).mean() == pytest.approx(1.0)
    assert spread_of_starts(columns_of(4000, rng, spread=0.5), base).mean() == pytest.approx(0.25, rel=0.05)


def test_effects_that_are_there_are_found_with_their_size() -> None:
    rng = np.random.default_rng(1)
    found = compare_starts(columns_of(400, rng, faster=1.2, spread=0.7), columns_of(2000, rng), "failing / ordinary")
    by_claim = {each.claim: each for each in found}
    assert by_claim["vehicles behind the ego are 20 % faster"].verdict == "holds"
    assert by_claim["variances of the initial conditions are 50 % smaller"].verdict.startswith("holds")
    assert by_claim["vehicles box in the ego"].verdict == "holds"


def test_runs_that_do_not_differ_show_nothing() -> None:
    rng = np.random.default_rng(5)
    found = compare_starts(columns_of(300, rng), columns_of(2000, rng), "failing / ordinary")
    assert [each.verdict for each in found] == ["not seen here"] * 4


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((1.1, 1.3), "holds"),
        ((1.01, 1.1), "holds, but less: 1.2 in the paper"),
        ((1.3, 1.6), "holds, but more: 1.2 in the paper"),
        ((0.9, 1.1), "not seen here"),
        ((0.8, 0.9), "the opposite here"),
        ((np.nan, 1.0), "cannot be told"),
        (None, "cannot be told"),
    ],
)
def test_verdicts(interval: tuple[float, float] | None, verdict: str) -> None:
    assert PaperClaim("", above=True, printed=1.2).judge(interval) == verdict


def test_the_interval_of_a_ratio_holds_the_ratio_as_often_as_it_says() -> None:
    rng = np.random.default_rng(2)
    intervals = [bootstrap_ratio(rng.normal(12, 2, 60), rng.normal(10, 2, 80)) for _ in range(30)]
    assert sum(low <= 1.2 <= high for low, high in intervals) >= 25  # 28.5 expected


def test_where_no_ordinary_run_has_any_the_shares_of_runs_are_compared() -> None:
    claim = PaperClaim("more lane changes", above=True)
    none = compare_means(claim, "lane changes", np.zeros(512), np.zeros(512))
    assert (none.value, none.verdict) == (0.0, "not seen here")
    assert none.interval == pytest.approx((-0.00745, 0.00745), abs=1e-5)
    assert "0 of 512 and 0 of 512; Fisher's exact test, p = 1" in none.statistic
    some = compare_means(claim, "lane changes", np.repeat([0.2, 0.0], [9, 91]), np.zeros(100))
    assert (some.value, some.verdict) == (0.09, "holds")
    assert compare_means(PaperClaim("fewer", above=False), "", np.ones(50), np.zeros(50)).verdict == "the opposite here"
    assert compare_means(claim, "lane changes", np.zeros(1), np.zeros(20)).verdict == "cannot be told"


@pytest.mark.parametrize(
    ("first", "second", "ends"), [((9, 10), (3, 10), (0.1705, 0.8090)), ((5, 56), (0, 29), (-0.0381, 0.1926))]
)
def test_intervals_of_differences_are_those_of_newcombe(first, second, ends) -> None:
    assert difference_interval(first, second) == pytest.approx(ends, abs=5e-5)
