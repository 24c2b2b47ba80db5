"""Egos, the calibration against people and retraining: what is counted, kept and held out, on made-up counts."""

import json

import numpy as np
import pytest
import torch

import rare_envs
import samplers
from benchmarks.driving import egos, human_calibration, reference_grid
from benchmarks.driving.egos import evaluate_ego, read_results, write_results
from benchmarks.driving.human_calibration import (
    CALIBRATION_RESULT,
    HUMAN,
    NO_HEADWAY_RULE,
    STRATA,
    CalibrationCell,
    Drawn,
    add,
    calibrate,
    count,
    find_events,
    find_stratum,
    format_measured,
    judge,
    make_problem,
    plan,
    to_package,
)
from benchmarks.training import retraining
from benchmarks.training.retraining import RetrainingRound, compare_arms, format_rounds, run_arm
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING
from rare_envs.people import ModelCount
from rare_envs.scenarios.registry import SCENARIOS


def test_an_ego_is_measured_and_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(egos, "EGOS_RESULT", tmp_path / "egos.json")
    assert read_results() == {}
    cell = evaluate_ego("rare_envs/CarFollowing-v0", "idm", "auto", 10, tmp_path, at_most=1000)
    assert (cell["words"].partition(",")[0], cell["steps"]) == ("rear_end", 0)
    assert 0 < cell["low"] < cell["p"] < cell["high"] and cell["n_sim"] <= 1000
    write_results({(cell["env_id"], cell["ego"]): cell})
    assert read_results() == {("rare_envs/CarFollowing-v0", "idm"): cell}


KM_100CAR = 2e6 * 1.609344


class Blind:
    """Cutters who have not looked, beside the ego or near it."""

    def __init__(self, base):
        self.base = base

    def sample(self, n, rng):
        x = self.base.sample(n, rng)
        x[:, 3], x[:, 7] = rng.uniform(-8.0, 8.0, n), -6.0
        return x


@pytest.mark.parametrize("change", ["", "noticed after 1 s"])
def test_outcomes_are_those_of_near_crash(change, monkeypatch) -> None:
    monkeypatch.setattr(SCENARIOS, "data", {**SCENARIOS.data})  # a change of the cutter is a scenario of its own
    monkeypatch.setattr(human_calibration, "find_stratum", lambda base, name: Blind(base))
    drawn = Drawn("us101", "unseen", "human", change)
    (cell,) = count([(drawn, 300)], seed=3, workers=1)
    around = rare_envs.DrivingProblem(make_problem(drawn).env_id, ego="human", measure="near_crash", base="us101")
    x = Blind(around.base).sample(300, np.random.default_rng([3, list(STRATA).index("unseen"), 0]))
    f = around.evaluate(x)
    near = (f <= 0.0) & (f > -100.0)
    assert (cell.draws, cell.contacts, cell.near_crashes) == (300, int((f == -100.0).sum()), int(near.sum()))
    assert cell.evaded == int((f[near] == 0.0).sum()) > 30
    assert cell.flanks == around.crash_kinds(x[f == -100.0]).count("side") > 0


def make_cells(stop, near=200, draws=1_000_000):
    """Cells of the two human drivers with other contacts of leads that stop."""
    counts = {"looked": (10, 0, 0), "unseen": (10_000, 0, 400_000), "stop": (stop, near, 0), "slowing": (0, 40, 0)}
    return [
        CalibrationCell("us101", name, ego, "", draws, 0, counter, evaded, hits, 0)
        for ego in (HUMAN, NO_HEADWAY_RULE)
        for name, (hits, counter, evaded) in counts.items()
    ]


EVENTS_OF_US101 = {
    "cut_in": (0.26, {"looked": 1.0 - 1e-4, "unseen": 1e-4}),
    "stop": (0.19, {"stop": 1.0}),
    "slowing": (1.04, {"slowing": 1.0}),
}


def test_strata_are_added_by_their_shares_and_compared_with_people(monkeypatch) -> None:
    """People: 13 contacts with stopping leads have the exact interval 6.92 to 22.2, in 3.2 million km."""
    monkeypatch.setattr(human_calibration, "find_events", lambda site: EVENTS_OF_US101)
    high = 22.23 / KM_100CAR / 0.19
    for contacts, factor, word in (
        (20, 1.0, "met"),
        (round(2e6 * high), 2.0, "met"),
        (round(4e6 * high), 4.0, "MISSED"),
    ):
        cells = make_cells(contacts)
        found = calibrate(cells, "us101")
        assert found["stop"].factor() == pytest.approx(factor, rel=0.02)
        (told,) = [each for each in judge(found) if each.startswith("contacts per lead that stops")]
        assert f"**{word}**" in told
        read = to_package(cells, ["us101"], "")["events"]["stop"]["us101"]
        assert read["drivers"][HUMAN]["contacts"][0] == pytest.approx(contacts / 1e6, rel=0.01)
    cut_ins = found["cut_in"].drivers[HUMAN]
    assert cut_ins["contacts"].p == pytest.approx(1e-5 + 1e-4 * 1e-2, rel=1e-3)
    assert cut_ins["near_crashes"].p == pytest.approx(1e-4 * 0.4, rel=1e-3)
    assert "under 3.6 %" in format_measured(cells, ["us101"], "a command")


def test_the_interval_of_a_sum_adds_squares_of_distances() -> None:
    parts = [(0.5, ModelCount(0.2, 0.1, 0.4)), (0.25, ModelCount(0.4, 0.0, 0.8))]
    assert add(parts) == pytest.approx((0.2, 0.2 - (0.05**2 + 0.1**2) ** 0.5, 0.2 + (0.1**2 + 0.1**2) ** 0.5))


class FullBraking:
    """An ego that brakes as hard as a human can from the first moment on."""

    def act(self, episode, memory):
        return torch.tensor([-MAX_HUMAN_BRAKING, 0.0]).expand(len(episode.collided), 2), memory


def read_cells():
    """Cells of the committed measurement, 1e6 draws of those who drive as they are."""
    return [CalibrationCell(**each) for each in json.loads(CALIBRATION_RESULT.read_text(encoding="utf-8"))["cells"]]


def drive_cells():
    return list(count(plan(["us101"], 300_000, [HUMAN], changes=False), seed=1, workers=1))


@pytest.mark.parametrize("cells_of", [read_cells, pytest.param(drive_cells, marks=pytest.mark.slow)])
def test_the_human_driver_crashes_and_nearly_crashes_as_often_as_people(cells_of) -> None:
    """Bands that were written down before the model was: contacts and near-crashes per event."""
    cells = cells_of()
    found = calibrate(cells, "us101")
    bands = {
        ("cut_in", "contacts"): (1e-8, 2e-5),
        ("cut_in", "near_crashes"): (5e-5, 6e-4),
        ("stop", "contacts"): (4e-6, 1.1e-4),
        ("stop", "near_crashes"): (6e-5, 2e-3),
    }
    for (event, outcome), (low, high) in bands.items():
        assert low <= found[event].drivers[HUMAN][outcome].p <= high, (event, outcome)
    of = {cell.stratum: cell for cell in cells if (cell.site, cell.ego, cell.change) == ("us101", HUMAN, "")}
    unseen = of["unseen"]
    assert unseen.contacts < 0.04 * (unseen.contacts + unseen.near_crashes)
    # held out: the 58 sideswipe conflicts that subjects of the 100-Car study suffered
    per_km, shares = find_events("us101")["cut_in"]
    assert 58 / 2 <= KM_100CAR * per_km * shares["unseen"] * unseen.evaded / unseen.draws <= 58 * 2
    # held out: brakings without a stop, none of whose contacts people had in 3.3 million of them
    assert of["slowing"].contacts <= 4
    near = found["slowing"].drivers[HUMAN]["near_crashes"]
    assert near.high >= found["slowing"].people("near_crashes")[1][0] / 5
    assert near.low <= found["slowing"].people("near_crashes")[1][1] * 5


@pytest.mark.parametrize("site", ["us101", "i80"])
def test_shares_of_cutters_who_had_not_looked_are_those_that_give_the_44_near_crashes(site) -> None:
    """44 own changes of the 100-Car study, by the near-crashes per change without a look of the model that stands."""
    (cell,) = (c for c in read_cells() if (c.site, c.stratum, c.ego, c.change) == (site, "unseen", HUMAN, ""))
    per_km, shares = find_events(site)["cut_in"]
    assert shares["unseen"] == pytest.approx(44 / (KM_100CAR * per_km * cell.near_crashes / cell.draws), rel=0.02)


@pytest.mark.slow
def test_whoever_brakes_at_once_never_has_to_brake_by_half_a_g() -> None:
    """Cut-ins that a cutter has accepted leave room: no such moment in 100,000 of them."""
    around = rare_envs.DrivingProblem("rare_envs/CutIn-v1", FullBraking(), "required_deceleration", "us101")
    x = find_stratum(around.base, "looked").sample(100_000, np.random.default_rng(0))
    assert around.evaluate(x).min() > 5.0 - 0.5 * 9.80665


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


def test_the_table_and_the_ratio_of_the_arms():
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


@pytest.mark.parametrize("name", reference_grid.THEIRS)
def test_the_recorded_verdicts_on_the_cut_ins_of_the_regulation_are_those_of_the_drivers(name: str) -> None:
    """At the first cell in which only ours crashes it does; and where nobody is near, it does not."""
    recorded = json.loads((reference_grid.RESULT).read_text())["drivers"][name]
    cells = np.array([recorded["only ours crashes"]["cells with them"][0], [30.0, 20.0, 50.0, 1.2]])
    assert reference_grid.find_ours(name, cells, cruise=False).tolist() == [True, False]
    assert recorded["unpreventable with car following"] <= recorded["unpreventable"]
