"""Fits to a user's own recordings: filters, frequencies, files of each format, progress, and what is refused."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario
from tests.training.data.recordings import (
    CLOCK,
    PAUSE,
    coifman_matrix,
    i24_documents,
    simulate,
    stopping_traffic,
    tgsim_rows,
    write_coifman,
    write_csv,
    write_i24,
)
from training.command_line import EventOptions
from training.data.events import braking_exposure, car_following_events, cut_in_events
from training.data.table import synthetic_traffic
from training.fit import recordings
from training.fit.base import fit_base
from training.fit.filters import EVENT_RECIPES, EventSet, filter_events, read_events, recorded_parameters
from training.fit.recordings import count_events, fit_bases, fit_own_bases, observe_traffic
from training.fit.strata import check_events

GOOD = [15.0, 14.0, 16.0, 12.0, 20.0, 3.0, 4.5]


@pytest.fixture(scope="module")
def simulated():
    return simulate(0, lanes=3, per_lane=12, seconds=20.0, changers=0.8)


def fit(out, between=None, scenarios=None, force=False, **source):
    options = {"scenarios": scenarios, "n_refits": 2, "progress": True, "force": force}
    return fit_bases(EventOptions(**source, between=between), out, **options)


def write_events(path, rows):
    columns = ["phase", *EVENT_RECIPES["cut_in"].columns, "start_seen", "recording", "frame"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


def test_filters_drop_and_count(tmp_path):
    path = tmp_path / EVENT_RECIPES["cut_in"].file
    write_events(
        path,
        [
            ["start", *GOOD, True, "a", 299],
            ["crossing", *GOOD, True, "a", 299],
            ["start", *GOOD, False, "a", 300],
            ["start", "", *GOOD[1:], True, "a", 1],  # no ego
            ["start", *GOOD[:3], -2.0, *GOOD[4:], True, "a", 1],  # side by side
            ["start", *GOOD[:5], 1.5, 4.5, True, "b", 10],  # bodies overlap across
            ["start", 16.0, *GOOD[1:], True, "a", 10],
            ["start", *GOOD[:6], "", True, "a", 11],  # the end was not recorded
            ["start", *GOOD[:6], 1.2, True, "a", 12],  # faster than tyres allow
        ],
    )
    recipe, box = replace(EVENT_RECIPES["cut_in"], answers=()), recorded_parameters("cut_in")
    events = filter_events(read_events(path, recipe), recipe, box)
    points, shapes, log = events.joint, events.apart, events.log
    # speeds and gaps count even where the offset at the start was not seen or is out of range, or the duration
    assert points.tolist() == [GOOD[:5], GOOD[:5], GOOD[:5], [16.0, *GOOD[1:5]], GOOD[:5], GOOD[:5]]
    assert shapes.tolist() == [[3.0, 4.5], [3.0, 4.5]]
    # 30 s windows: frame 299 of a, frame 300 of a, frame 10 of b, frame 10 of a
    assert (events.clusters == events.clusters[[0, 3]][:, None]).tolist() == [
        [True, False, False, True, True, True]
    ] * 2
    assert (events.counts.used, events.counts.clusters, events.counts.cluster) == ((6, 2), 3, "half-minute")
    assert log[0]["events"] == 8
    assert [entry["events"] for entry in log if entry["rule"] == "events used"] == [6, 2]
    dropped = {entry["rule"]: entry["dropped"] for entry in log if entry.get("dropped")}
    assert dropped == {
        "v_ego is given": 1,
        "start_seen": 1,
        "1 <= gap_ego_cutin <= 120 m": 1,
        "2.2 <= lateral_offset <= 5 m": 1,
        "duration is given": 1,
        "1.5 <= duration <= 12 s": 1,
    }


def test_pairs_that_were_under_way_are_no_new_leaders(tmp_path):
    path = tmp_path / "car_following_events.csv"
    rows = ["v_ego,v_lead,gap,at_entry,recording,frame", "10,9,20,true,a,0", "11,9,20,false,a,5", "12,9,0.5,false,a,9"]
    path.write_text("\n".join(rows) + "\n", encoding="utf-8")
    recipe = EVENT_RECIPES["car_following"]
    events = filter_events(read_events(path, recipe), recipe, find_scenario("car_following").parameters)
    assert events.joint.tolist() == [[11.0, 9.0, 20.0]]
    dropped = {entry["rule"]: entry["dropped"] for entry in events.log if entry.get("dropped")}
    assert dropped == {"not at_entry": 1, "1 <= gap <= 150 m": 1}


def test_events_count_with_the_share_that_is_used():
    driven = np.array([2.0, 100.0, 0.0, 0.0])  # h, km
    pairs = {"at_entry": np.array([True, False, False, True, False, False]), "ego": np.arange(6)}
    frequency = count_events("car_following", pairs, 3, driven)
    assert (frequency.count, frequency.share_events) == (4, 4)
    assert frequency.per_hour == pytest.approx(3 / 2.0)
    cuts = {"phase": np.array(["start", "crossing"] * 4), "ego": np.array([1, 1, 2, 2, -1, -1, 3, 3])}
    frequency = count_events("cut_in", cuts, 2, driven)
    assert (frequency.count, frequency.share_events) == (3, 3)
    assert frequency.per_hour == pytest.approx(3 / 2.0 * 2 / 3)
    assert frequency.per_km == pytest.approx(3 / 100.0 * 2 / 3)
    table = synthetic_traffic(seconds=4.0, per_lane=2)  # nobody changes lane: all pairs are there at first
    assert count_events("cut_in", cut_in_events(table), 0, driven) is None
    pairs = car_following_events(table)
    assert count_events("car_following", pairs, len(pairs["ego"]), observe_traffic(table)) is None


def test_bases_are_fitted_to_recordings(simulated, quick, tmp_path, capsys):
    write_csv(tmp_path / "I294_L1.csv", tgsim_rows(simulated, radius=900.0, angle=2.6))
    files = fit(tmp_path / "bases", tgsim=tmp_path)
    assert [file.name for file in files] == [
        "car_following_own.json",
        "cut_in_own.json",
        "hard_brake_own.json",
    ]
    assert [each.name for each in load_base(find_scenario("hard_brake"), files[2]).strata] == ["slowing"]
    own = load_base(find_scenario("cut_in"), files[1])
    assert [each.name for each in own.strata] == ["unseen", "looked"]
    assert own.record["motion"]["cutters"]["events"] > 10
    for each in own.strata:  # nobody begins with the lead inside the ego
        assert (each.base.sample(20_000, np.random.default_rng(0))[:, 3:5].sum(axis=1) + 5.0 >= 1.0 - 1e-9).all()
    printed = capsys.readouterr().err
    assert "cut_in, recorded / expected: looked: TTC < 2 s " in printed and "cut_in, followers: " in printed
    for scenario, file in zip(("car_following", "cut_in"), files, strict=False):
        points = load_base(find_scenario(scenario), file).sample(100, np.random.default_rng(0))
        assert np.isfinite(points).all() and 12.0 < points[:, 0].mean() < 25.0  # simulated: 9 to 27 m/s
        source = json.loads(file.read_text(encoding="utf-8"))["provenance"]["source"]
        assert source["data"] == "recordings I294_L1-1-left"


def test_too_few_events_are_an_error_that_names_all_scenarios(simulated, quick, tmp_path, capsys):
    path = write_i24(tmp_path / "morning.json", i24_documents(simulated))
    every = "No base of car_following, cut_in, hard_brake is written: give more recordings."
    with pytest.raises(ValueError, match=every):
        fit(tmp_path, (CLOCK, CLOCK + 2.0), i24=path)
    path = write_coifman(tmp_path / "i80.mat", coifman_matrix(simulated))
    capsys.readouterr()
    with pytest.raises(ValueError, match="too few"):  # there is no lateral offset
        fit(tmp_path, scenarios=["cut_in"], coifman=path, force=True)
    read, events = capsys.readouterr().err.splitlines()
    assert "rows read" in read and events.startswith("cut_in: ") and events.endswith(" events")


def test_a_hard_brake_base_is_fitted_to_brakings_to_a_standstill(quick, tmp_path):
    """The recipe of the shipped base: filters, refits of half-minutes, checks and frequency in one file."""
    rng = np.random.default_rng(4)
    n = 40
    speeds, decelerations = rng.uniform(8.0, 16.0, n), np.exp(rng.normal(np.log(2.0), 0.25, n))
    table = stopping_traffic(speeds, np.exp(rng.normal(np.log(12.0), 0.4, n)), decelerations)
    fit_own_bases([table], ["hard_brake"], tmp_path, "stops", n_refits=3)
    base = load_base(find_scenario("hard_brake"), tmp_path / "hard_brake_stops.json")
    assert base.events.used == (n,) and base.events.cluster == "half-minute"
    assert base.events.clusters == len(np.unique((400 * np.arange(n) + PAUSE - 8) // 300))
    assert len(base.refits) == 3
    points = base.sample(2000, np.random.default_rng(0))
    for column, recorded in ((0, speeds), (2, decelerations)):
        assert points[:, column].mean() == pytest.approx(recorded.mean(), rel=0.12)
    assert base.frequency.count == n
    seconds, metres = braking_exposure(np.split(table.x, table.track_starts()[1:]))
    assert base.frequency.per_hour == pytest.approx(3600 * n / seconds, rel=1e-3)
    assert base.frequency.per_km == pytest.approx(1000 * n / metres, rel=1e-3)
    assert [check.name for check in base.checks] == [
        f"stop: {name}" for name in ("time headway < 0.5 s", "gap < 3 m", "peak > 3 m/s^2")
    ]
    assert [each.name for each in base.strata] == ["stop"]  # nobody slowed only
    assert (points[:, 3] >= points[:, 0]).all()
    dropped = {rule["rule"]: rule["dropped"] for rule in base.record["filters"] if rule.get("dropped")}
    assert dropped == {"gap is given": n}  # the leaders


@pytest.mark.parametrize("parameter", ["lateral_offset", "duration", "ego_speed", "cut_in_gap"])
@pytest.mark.parametrize("spread", [0.0, 2e-4])
def test_events_that_hardly_vary_are_refused_before_anything_is_written(parameter, spread, tmp_path, monkeypatch):
    number = [p.name for p in recorded_parameters("cut_in")].index(parameter)

    def starts(_):
        rng = np.random.default_rng(0)
        x = np.array(GOOD) * np.exp(0.1 * rng.standard_normal((30, 7)))
        x[:, number] = GOOD[number] + spread * rng.standard_normal(30)
        recipe = EVENT_RECIPES["cut_in"]
        events = dict(zip(recipe.columns, x.T, strict=True)) | dict.fromkeys(recipe.answers, np.full(30, np.nan))
        flags = {"start_seen": np.full(30, True), "phase": np.full(30, "start"), "ego": np.arange(30)}
        return events | flags | {"recording": np.full(30, "a"), "frame": 300 * np.arange(30)}

    monkeypatch.setitem(recordings.EXTRACTORS, "cut_in", starts)
    table = synthetic_traffic(seconds=4.0, per_lane=2)
    out = tmp_path / "bases"
    message = rf"cut_in: {parameter} is [\d.]+ \S+ in nearly all of 30 events .* Nothing is written"
    with pytest.raises(ValueError, match=message) as refused:
        fit_own_bases([table], ["cut_in"], out, "own", n_refits=2)
    assert "\n" not in str(refused.value) and not out.exists()


def test_a_start_that_no_braking_saves_is_of_nobody_who_looked():
    rng = np.random.default_rng(0)
    x = np.array(GOOD) * np.exp(0.1 * rng.standard_normal((30, 7)))
    x[0, [0, 1, 3]] = 20.0, 12.0, 4.0  # 8 m/s faster, 4 m behind
    kept = check_events("cut_in", EventSet(x[:, :5], np.arange(30), x[:, 5:]))
    assert len(kept.joint) == 29 and kept.log[-2]["dropped"] == 1


def test_a_model_too_narrow_for_estimates_is_refused():
    rng = np.random.default_rng(0)
    x = np.array(GOOD) * np.exp(0.1 * rng.standard_normal((60, 7)))
    x[:, 3] = 15.0 + 0.3 * rng.standard_normal(60)
    us101 = load_base(find_scenario("cut_in"), "us101")
    with pytest.raises(ValueError, match=r"cut_in_gap varies too little \(standard deviation 0\.3"):
        fit_base("cut_in", EventSet(x[:, :5], np.arange(60), x[:, 5:]), {}, "", neighbours=us101, n_refits=2)
