"""O'Kelly et al. 2018 on problems that cost nothing, and the committed records."""

from __future__ import annotations

import json
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import samplers
from benchmarks.papers.okelly2018 import findings, reproduction
from benchmarks.papers.okelly2018 import study as study_module
from benchmarks.papers.okelly2018.findings import (
    PaperClaim,
    RunBehaviour,
    bootstrap_ratio,
    compare_behaviour,
    compare_means,
    compare_starts,
    difference_interval,
    distances_beside,
    find_least_time,
    measure_behaviour,
    speed_behind,
    spread_of_starts,
)
from benchmarks.papers.okelly2018.reproduction import (
    compare_with_naive,
    estimate_naive,
    estimate_weighted,
    reproduce_okelly2018,
    summarise_highway,
    write_notes,
)
from benchmarks.papers.okelly2018.study import (
    CORE_SPEEDS,
    PRINTED_SEARCH,
    SEARCHES,
    HighwayStudy,
    RolloutFolder,
    SearchSettings,
    StudyScale,
    choose_sampler,
    describe_sampler,
    draw_chunk,
    find_log_ratios,
    join_outcomes,
    make_base,
    measure_highway,
    split_jobs,
    take_step,
)
from benchmarks.results_page import read
from rare_envs.simulation import drive
from rare_envs.startup import use_one_thread
from rare_envs.study.arguments import BadInput
from samplers import FunctionProblem
from samplers.distributions import BetaBlock, NormalBlock, Product
from samplers.proposals import Gaussian

TINY = StudyScale(naive=1000, iterations=2, draws=300, final=300, own=0, chunk=100)
BASE = Product(
    (
        BetaBlock(alpha=np.full(2, 2.0), beta=2.0, low=0.0, high=10.0),
        NormalBlock(Gaussian.standard(3), radius=0.5),
    )
)


class CheapHighway:
    """f is small where a neighbour starts beside the ego; no simulation."""

    def __init__(self, problem: Any) -> None:
        self.space, self.base, self.dim = problem.space, problem.base, problem.dim
        self.world, self.driver, self.tile = problem.world, problem.driver, problem.tile
        self.evaluated = 0

    def evaluate(self, x: Any) -> Any:
        self.evaluated += len(x)
        columns = self.space.columns(x)
        distance = np.abs(columns["s"][:, 2] - columns["s"][:, 0])
        return 0.3 + distance / 10.0 + (columns["speed"][:, 0] - 10.0) / 10.0


@pytest.fixture(scope="module")
def highway() -> Any:
    return HighwayStudy().make_problem()


@pytest.fixture
def cheap(highway: Any) -> CheapHighway:
    return CheapHighway(highway)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> HighwayStudy:
    """A study of few rollouts; the drives of its findings are taken away."""
    monkeypatch.setitem(study_module.STUDY_SCALES, ("lidar", "small"), TINY)
    monkeypatch.setattr(findings, "RESAMPLES", 99)
    monkeypatch.setattr(reproduction, "measure_behaviour", lambda problem, x: RunBehaviour(*np.ones((4, len(x)))))
    return HighwayStudy()


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "okelly"


def measure(study: HighwayStudy, folder: Path, problem: Any, limit: int | None = None):
    return measure_highway(RolloutFolder(study, folder, problem, limit=limit))


# rollouts in files


def outcomes(folder: Path, **options: Any) -> list[np.ndarray]:
    problem = FunctionProblem(lambda x: x[:, 0] / 3.0, dim=2)
    rollouts = RolloutFolder(HighwayStudy(seed=3), folder, problem, **options)
    folder.mkdir(exist_ok=True)
    jobs = split_jobs("naive", 250, 100, Product((NormalBlock(Gaussian.standard(2)),)))
    return [join_outcomes([line]) for line in rollouts.outcomes(jobs)]


def test_chunks_give_the_same_however_often_a_run_is_stopped_and_wherever_it_is_made(tmp_path: Path) -> None:
    whole = outcomes(tmp_path / "a")
    assert [len(f) for f in whole] == [100, 100, 50]
    assert [len(outcomes(tmp_path / "b", limit=120)), len(outcomes(tmp_path / "b", limit=100))] == [1, 2]
    file = tmp_path / "a" / "naive.jsonl"
    line = json.loads(file.read_text().splitlines()[1])
    assert (line["key"], line["seed"]) == ("naive/0", 3)
    assert (join_outcomes([line]) == whole[0]).all()
    file.write_text(file.read_text()[:-30])  # a torn line is made again
    for folder, options in (("a", {}), ("b", {}), ("c", {"executor": ThreadPoolExecutor(2)})):
        assert (np.concatenate(outcomes(tmp_path / folder, **options)) == np.concatenate(whole)).all()
    file.write_text(file.read_text() + '{"n": 3}\n')
    with pytest.raises(BadInput, match="line 5 is no run of this command"):
        outcomes(tmp_path / "a")
    others = RolloutFolder(HighwayStudy(), tmp_path, None, limit=100)
    assert [others.spend(60), others.spend(60), others.made] == [True, False, 60]


# algorithm 1


def test_a_step_moves_towards_small_outcomes_within_the_box() -> None:
    x = draw_chunk(BASE, 2000, 0, "a")
    f = x[:, 0] - 2.0 * x[:, 3]
    step, sampler = take_step(BASE, BASE, x, f, SearchSettings(0.1), gamma=-100.0)
    assert step.level == step.quantile == np.sort(f)[199]
    assert (step.elite, step.ess) == (200, pytest.approx(200.0))
    moved = describe_sampler(BASE, sampler)
    assert moved["mean"][0] < 4.0 < moved["mean"][1] < 6.0  # type: ignore[index, operator]
    assert moved["largest_shift"] == pytest.approx(0.5)
    assert describe_sampler(BASE, BASE)["variance"] == pytest.approx([5.0, 5.0])  # 100 / 20


def test_the_level_stops_at_gamma_and_the_lowest_quantile_is_chosen() -> None:
    x = draw_chunk(BASE, 1000, 0, "a")
    step, _ = take_step(BASE, BASE, x, x[:, 0], SearchSettings(0.1), gamma=5.0)
    assert step.level == 5.0 > step.quantile
    assert step.elite == (x[:, 0] <= 5.0).sum()
    steps = [take_step(BASE, BASE, x, x[:, 0] + shift, SearchSettings(0.1), -9.0)[0] for shift in (1.0, 0.0, 0.0)]
    assert choose_sampler(steps) == 1


def test_weights_that_do_not_move_stay() -> None:
    settings = SearchSettings(0.1, weights_move=False)
    base = make_base(FunctionProblem(lambda x: x[:, 0], dim=5, base=BASE), settings)
    x = draw_chunk(base, 1000, 0, "a")
    _, sampler = take_step(base, base, x, x[:, 0] - x[:, 3], settings, gamma=-100.0)
    moved = describe_sampler(base, sampler)
    assert moved["largest_shift"] == moved["shift"] == 0.0
    assert moved["mean"][0] < 4.0  # type: ignore[index, operator]


def test_draws_are_those_of_seed_and_key_and_likelihood_ratios_have_mean_1() -> None:
    first = draw_chunk(BASE, 5, 1, "naive/0")
    assert (first == draw_chunk(BASE, 5, 1, "naive/0")).all()
    assert (first != draw_chunk(BASE, 5, 1, "naive/1")).any()
    assert (first != draw_chunk(BASE, 5, 2, "naive/0")).any()
    near = Product((BetaBlock(alpha=np.full(2, 2.5), beta=2.0, low=0.0, high=10.0), BASE.blocks[1]))
    x = draw_chunk(near, 20_000, 0, "a")
    assert np.exp(find_log_ratios(BASE, near, x)).mean() == pytest.approx(1.0, abs=0.02)


# estimates


def test_naive_and_weighted_estimates() -> None:
    f = np.random.default_rng(0).random(1000)
    naive, weighted = estimate_naive(f, 0.1), estimate_weighted(f, np.zeros(1000), 0.1)
    assert naive["standard_error"] == pytest.approx(math.sqrt(naive["p"] * (1 - naive["p"]) / 1000))
    for name in ("p", "standard_error"):
        assert weighted[name] == pytest.approx(naive[name])
    assert weighted["ess"] == pytest.approx(naive["events"])
    x = np.random.default_rng(1).normal(3.0, 1.0, 20_000)  # a shifted normal finds the tail of a normal
    found = estimate_weighted(-x, -3.0 * x + 4.5, -3.0)  # log phi(x) - log phi(x - 3)
    assert abs(found["p"] - 1.3499e-3) < 4 * found["standard_error"] < 4 * 3e-5


def test_comparisons_with_naive_monte_carlo() -> None:
    naive = {"gamma": 0.5, "n": 10_000, "events": 10, "p": 1e-3, "standard_error": 3.2e-4}
    tilted = {"gamma": 0.5, "n": 1000, "events": 20, "p": 1e-3, "standard_error": 1e-4}
    both = compare_with_naive(tilted, naive, search=4000)
    assert both["events_ratio"] == pytest.approx(20.0)
    assert both["events_interval"][0] < 20.0 < both["events_interval"][1]
    ratios = [both[name] for name in ("variance_ratio", "all_in", "error_ratio", "errors_off")]
    assert ratios == pytest.approx([99.9, 99.9 / 5, 99.9 / 5, 0.0])
    missed = {**tilted, "events": 900, "p": 1e-30, "standard_error": 1e-30}
    blind = compare_with_naive(missed, naive, search=0)
    assert blind["variance_ratio"] > 1e40
    assert blind["error_ratio"] == pytest.approx(1.0, rel=0.01)  # no gain by distance
    for events in (0, 5):
        few = {**naive, "n": 1000, "events": events, "p": events / 1000, "standard_error": 0.0}
        nothing = compare_with_naive({**tilted, "events": 0, "p": 0.0, "standard_error": 0.0}, few, search=0)
        assert (nothing["variance_ratio"], nothing["events_ratio"]) == (None, 0.0 if events else None)


# findings


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


def test_values_of_starts() -> None:
    s = np.array([[100.0, 90.0, 95.0, 112.0, 130.0, 100.0]])
    columns = {"s": s, "speed": np.array([[15.0, 20.0, 10.0, 99.0, 99.0, 99.0]])}
    assert speed_behind(columns)[0] == 15.0
    assert distances_beside(columns).tolist() == [[5.0, 12.0]]
    alone = {"s": np.array([[90.0, 91.0, 92.0, 93.0, 94.0, 95.0]]), "speed": np.full((1, 6), 15.0)}
    assert np.isnan(speed_behind(alone)).all()
    rng = np.random.default_rng(0)
    base = columns_of(4000, rng)
    assert spread_of_starts(base, base).mean() == pytest.approx(1.0)
    assert spread_of_starts(columns_of(4000, rng, spread=0.5), base).mean() == pytest.approx(0.25, rel=0.05)


def test_effects_that_are_there_are_found_and_others_are_not() -> None:
    rng = np.random.default_rng(1)
    found = compare_starts(columns_of(400, rng, faster=1.2, spread=0.7), columns_of(2000, rng), "failing / ordinary")
    verdicts = {each["claim"]: each["verdict"] for each in found}
    assert verdicts["vehicles behind the ego are 20 % faster"] == "holds"
    assert verdicts["variances of the initial conditions are 50 % smaller"].startswith("holds")
    assert verdicts["vehicles box in the ego"] == "holds"
    rng = np.random.default_rng(5)
    equal = compare_starts(columns_of(300, rng), columns_of(2000, rng), "failing / ordinary")
    assert [each["verdict"] for each in equal] == ["not seen here"] * 4


@pytest.mark.parametrize(
    ("interval", "verdict"),
    [
        ((1.1, 1.3), "holds"),
        ((1.01, 1.1), "holds, but less: 1.2 in the paper"),
        ((1.3, 1.6), "holds, but more: 1.2 in the paper"),
        ((0.9, 1.1), "not seen here"),
        ((0.8, 0.9), "the opposite here"),
        ((np.nan, 1.0), "cannot be told"),
    ],
)
def test_verdicts(interval: tuple[float, float], verdict: str) -> None:
    assert PaperClaim("", above=True, printed=1.2).judge(interval) == verdict


def test_intervals_of_ratios_and_differences() -> None:
    rng = np.random.default_rng(2)
    intervals = [bootstrap_ratio(rng.normal(12, 2, 60), rng.normal(10, 2, 80)) for _ in range(30)]
    assert sum(low <= 1.2 <= high for low, high in intervals) >= 25  # 28.5 expected
    for first, second, ends in (  # the examples of Newcombe (1998)
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.1705, 0.8090)),
        ((5, 56), (0, 29), (-0.0381, 0.1926)),
    ):
        assert difference_interval(first, second) == pytest.approx(ends, abs=5e-5)


def test_where_no_ordinary_run_has_any_the_shares_of_runs_are_compared() -> None:
    claim = PaperClaim("more lane changes", above=True)
    none = compare_means(claim, "lane changes", np.zeros(512), np.zeros(512))
    assert (none["value"], none["verdict"]) == (0.0, "not seen here")
    assert none["interval"] == pytest.approx((-0.00745, 0.00745), abs=1e-5)
    assert "0 of 512 and 0 of 512; Fisher's exact test, p = 1" in none["statistic"]
    some = compare_means(claim, "lane changes", np.repeat([0.2, 0.0], [9, 91]), np.zeros(100))
    assert (some["value"], some["verdict"]) == (0.09, "holds")
    fewer = compare_means(PaperClaim("fewer", above=False), "", np.ones(50), np.zeros(50))
    assert fewer["verdict"] == "the opposite here"
    assert compare_means(claim, "lane changes", np.zeros(1), np.zeros(20))["verdict"] == "cannot be told"


def test_behaviour_of_drives(highway: Any) -> None:
    x = highway.base.sample(8, np.random.default_rng(1))
    found = measure_behaviour(highway, x)
    assert all(values.shape == (8,) for values in found)
    assert ((found.hard_brakes >= 0) & (found.hard_brakes <= 1)).all()
    assert set(found.sideways) | set(found.collided) <= {0.0, 1.0}
    x = x[:2]
    x[:, :6] = (100.0, 81.0, 100.0, 119.0, 82.0, 118.0)  # the car on the left is beside the ego
    x[:, 12:18] = (0.0, 0.0, 3.5, 0.0, 0.0, 0.0)  # and comes over
    x[:, 18:24] = 15.0
    with torch.inference_mode():
        least, side = find_least_time(next(iter(drive(highway.world, highway.driver, torch.from_numpy(x).float()))))
    assert side.all()
    assert ((least > 0.5) & (least < 10.0)).all()


def test_more_of_everything_is_found_and_equal_runs_show_nothing() -> None:
    rng = np.random.default_rng(0)
    often, seldom = (RunBehaviour(*(rng.random((4, 300)) < share).astype(float)) for share in (0.6, 0.2))
    found = compare_behaviour(often, seldom, often, 900)
    assert [each["verdict"] for each in found] == ["holds"] * 3
    assert "300 of 900 driven again" in found[2]["statistic"]
    rng = np.random.default_rng(3)
    one, other = (RunBehaviour(*(rng.random((4, 300)) < 0.3).astype(float)) for _ in range(2))
    assert [each["verdict"] for each in compare_behaviour(one, other, one, 300)] == ["not seen here"] * 3


# the study


def test_all_stages_are_made_once_and_go_to_small_outcomes(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    measured = measure(tiny, out, cheap)
    scale = tiny.settings
    assert [len(run.steps) for run in measured.searches.values()] == [2] * len(SEARCHES)
    again = measure(tiny, out, cheap)
    assert cheap.evaluated == scale.naive + len(SEARCHES) * scale.per_search
    naive = join_outcomes(measured.naive)
    for name, run in measured.searches.items():
        assert [step.quantile for step in again.searches[name].steps] == [step.quantile for step in run.steps]
        final = join_outcomes(run.final)
        assert not name.endswith("0.1") or np.quantile(final, 0.1) < np.quantile(naive, 0.1) - 0.1
    part = measure(tiny, out / "other", cheap, limit=scale.naive + 400)
    first = next(iter(part.searches.values()))
    assert (len(first.steps), len(first.final)) == (1, 0)
    rest = measure(tiny, out / "other", cheap)  # a run that was stopped in a search goes on
    for name, run in measured.searches.items():
        assert (join_outcomes(rest.searches[name].final) == join_outcomes(run.final)).all()


def test_what_was_measured_is_summed_up(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    found = summarise_highway(tiny, cheap, measure(tiny, out, cheap))
    search = found["searches"]["starts alone, rho 0.1"]
    assert 0.3 < search["mean_ratio"] < 3.0
    assert abs(search["comparisons"][-1]["errors_off"]) < 4
    assert (search["search"], found["rollouts"]) == (600, 1000 + 4 * 900)
    verdicts = {each["claim"]: each["verdict"] for each in found["findings"][:4]}
    assert verdicts["vehicles box in the ego: neighbours are nearer"] == "holds"
    some = summarise_highway(tiny, cheap, measure(tiny, out / "some", cheap, limit=500))
    assert len(some["naive"]) == 4
    assert all(not each["estimates"] for each in some["searches"].values())
    none = summarise_highway(tiny, cheap, measure(tiny, out / "none", cheap, limit=0))
    assert (none["naive"], none["findings"], none["rollouts"]) == ([], [], 0)


def test_record_and_page_are_written(tiny: HighwayStudy, cheap: Any, out: Path) -> None:
    record = reproduce_okelly2018(RolloutFolder(tiny, out, cheap), "python -m benchmarks.papers okelly2018")
    assert json.loads((out / "reproduction.json").read_text()) == record
    page = (out / "reproduction.md").read_text()
    assert {path.stem for path in out.glob("*.png")} == {"figure2a", "figure2b"}
    assert "Made: 4,600 of 4,600 rollouts" in page
    assert "The full scale has 1,300,000 naive rollouts" in page
    assert len(record["findings"]) == 11


def test_a_full_scale_that_is_not_all_run_says_what_the_rest_takes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CORE_SPEEDS, "lidar", 1000.0)
    study = HighwayStudy("lidar", "full")
    rollouts = study.settings.rollouts - 24_000
    found = {"rollouts": rollouts - 3_600_000, "own": [], "naive": []}
    last = write_notes(study, found)[-1]
    assert "At 1,000 rollouts a second" in last and "the rest takes 1.0 hours; the same command goes on" in last
    assert len(write_notes(study, {**found, "rollouts": rollouts, "own": [{"n_sim": 6000}] * 4})) == 2


# the committed records


@pytest.fixture(scope="module", params=["okelly2018", "okelly2018_full", "okelly2018_vision"])
def committed(request: pytest.FixtureRequest) -> dict[str, Any]:
    return read(request.param)


def study_of(record: dict[str, Any]) -> HighwayStudy:
    about = record["about"]
    return HighwayStudy(about["ego"], about["scale"], about["seed"])


def test_the_first_rollouts_are_those_of_the_committed_run(committed: dict[str, Any]) -> None:
    study = study_of(committed)
    highway = study.make_problem()
    first = committed["runs"][0]["first"]
    base = make_base(highway, SEARCHES[PRINTED_SEARCH])
    x = draw_chunk(base, study.settings.chunk, study.seed, "naive/0")[: len(first)]
    assert highway.evaluate(x) == pytest.approx(first, abs=1e-3)


def test_the_first_iteration_of_a_search_made_again_is_the_committed_one(highway: Any) -> None:
    """Of the small scale: 1,000 rollouts."""
    record = read("okelly2018")
    study, name = study_of(record), "starts alone, rho 0.1"
    base, number = make_base(highway, SEARCHES[name]), list(SEARCHES).index(name) + 1
    (job,) = split_jobs(f"search_{number}/0", study.settings.draws, study.settings.chunk, base)
    x = draw_chunk(base, job.n, study.seed, job.key)
    step, _ = take_step(base, base, x, highway.evaluate(x), SEARCHES[name], study.gammas[0])
    shown = record["runs"][0]["searches"][name]["steps"][0]
    assert (step.elite, step.ess) == (shown["elite"], pytest.approx(shown["ess"]))
    assert (step.quantile, step.level) == pytest.approx((shown["quantile"], shown["level"]), rel=1e-5)


@pytest.mark.slow
def test_rows_of_the_committed_table_are_what_the_command_makes_again(out: Path) -> None:
    """Naive Monte Carlo with as many draws as a final sample has, and our default method at one threshold."""
    record = read("okelly2018")
    study = study_of(record)
    with use_one_thread():
        problem = study.make_problem()
        reproduce_okelly2018(RolloutFolder(study, out, problem, limit=study.settings.final), record["command"])
        own = samplers.estimate(problem, gamma=study.gammas[-1], seed=study.seed, max_sim=study.settings.own)
    again = json.loads((out / "reproduction.json").read_text())
    rows = [values_of(each, "naive, equal draws") for each in (again, record)]
    assert len(rows[0]) == 1 + 2 * len(study.gammas)
    assert rows[0] == rows[1]
    shown = {value["quantity"]: value for value in values_of(record, f"our default method, {own.n_sim:,} simulations")}
    assert (own.p, *own.interval) == pytest.approx((shown["p"]["ours"], *shown["p"]["interval"]), rel=1e-6)
    assert own.p * own.cov == pytest.approx(shown["standard error"]["ours"], rel=1e-6)


def values_of(record: dict[str, Any], label: str) -> list[dict[str, Any]]:
    """Return the values of a row of the first table, whose label begins with some words."""
    return [value for value in record["tables"][0]["values"] if value["labels"][0].startswith(label)]
