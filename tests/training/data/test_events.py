"""Events with pencil-and-paper answers, the recorded ones, and bases fitted to files of one's own."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import scenario_named
from tests.training.data.recordings import simulate, write_highd, write_ngsim
from training.data.events import (
    CAR_FOLLOWING_COLUMNS,
    CUT_IN_COLUMNS,
    MIN_PAIR_FRAMES,
    car_following_events,
    concatenate_events,
    cut_in_events,
    write_events,
)
from training.data.ngsim import load_ngsim
from training.data.ngsim_tables import SCENES_FILE, load_us101_trajectories
from training.data.trajectories import COLUMNS, NOBODY, Trajectories, find_leaders, tabulate
from training.data.windows import scenes_of
from training.scenario_fitting import fit as fit_scenarios
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.event_filters import EVENT_RECIPES

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not (DATA / SCENES_FILE).is_file(), reason=f"recorded traffic is not part of the repository: {DATA} is absent"
)
EDGES = (0.0, 3.5, 7.0)


def table_of(*tracks, edges=EDGES) -> Trajectories:
    """Tracks as (x, y, speed), each of shape (T,), all from frame 0; vehicles 1, 2, ... of 4 m length."""
    x, y, speed = (np.concatenate([np.broadcast_to(track[i], len(track[0])) for track in tracks]) for i in range(3))
    vehicle = np.concatenate([np.full(len(track[0]), number + 1) for number, track in enumerate(tracks)])
    frame = np.concatenate([np.arange(len(track[0])) for track in tracks])
    lane = np.searchsorted(edges, y, side="right")
    row = find_leaders(frame, lane, x)
    columns = {"recording": "r", "vehicle": vehicle, "frame": frame, "x": x, "y": y, "speed": speed, "lane": lane}
    columns |= {"acceleration": 0.5, "length": 4.0, "width": 1.8, "leader": np.where(row >= 0, vehicle[row], NOBODY)}
    return tabulate(columns, {"r": edges})


def test_a_pair_is_an_event_once_it_was_seen_for_two_seconds():
    t = 0.1 * np.arange(MIN_PAIR_FRAMES)
    follower, leader = (10.0 * t, 1.75, 10.0), (30.0 + 8.0 * t, 1.75, 8.0)
    events = car_following_events(table_of(follower, leader))
    assert tuple(events) == CAR_FOLLOWING_COLUMNS
    assert {name: values.tolist() for name, values in events.items()} == {
        "recording": ["r"],
        "frame": [0],
        "lane": [1],
        "ego": [1],
        "lead": [2],
        "v_ego": [10.0],
        "v_lead": [8.0],
        "gap": [26.0],
        "a_ego": [0.5],
        "a_lead": [0.5],
        "n": [MIN_PAIR_FRAMES],
    }
    shorter = [tuple(values[:-1] if np.ndim(values) else values for values in track) for track in (follower, leader)]
    assert len(car_following_events(table_of(*shorter))["gap"]) == 0
    beside = (30.0 + 8.0 * t, 5.25, 8.0)
    assert len(car_following_events(table_of(follower, beside))["gap"]) == 0


def cutting_in(sign=1.0, pause=20):
    """Vehicle 1 moves across at 1.3 m/s from second 2 on, between vehicles 2 (behind) and 3 (ahead)."""
    t = 0.1 * np.arange(90)
    across = 1.75 + np.clip(1.3 * (t - 0.1 * pause), 0.0, 3.5)
    y, other = (across, 5.25) if sign > 0 else (7.0 - across, 1.75)
    return table_of((20.0 + 10.0 * t, y, 10.0), (9.0 * t, other, 9.0), (50.0 + 12.0 * t, other, 12.0))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_cut_in_has_a_start_and_a_crossing(sign):
    events = cut_in_events(cutting_in(sign))
    assert tuple(events) == CUT_IN_COLUMNS
    assert events["phase"].tolist() == ["crossing", "start"]
    assert (events["vehicle"] == 1).all() and (events["ego"] == 2).all() and (events["lead"] == 3).all()
    assert events["from_lane"].tolist() == [1, 1] if sign > 0 else [2, 2]
    crossing, start = events["frame"].tolist()
    assert crossing == 34  # 1.75 m take 1.35 s
    assert start == 20  # one frame later 0.13 m in 0.5 s are more than 0.2 m/s
    assert events["start_seen"].all()
    np.testing.assert_allclose(events["lateral_speed"], 1.3)
    np.testing.assert_allclose(events["lateral_offset"][1], 3.5)
    seconds = 0.1 * events["frame"]
    np.testing.assert_allclose(events["gap_ego_cutin"], 16.0 + seconds)
    np.testing.assert_allclose(events["gap_cutin_lead"], 26.0 + 2.0 * seconds)
    assert (events["v_cutin"] == 10.0).all() and (events["v_ego"] == 9.0).all() and (events["v_lead"] == 12.0).all()


def test_a_start_before_the_track_is_not_seen_and_short_visits_do_not_count():
    events = cut_in_events(cutting_in(pause=0))
    assert not events["start_seen"].any()
    t = 0.1 * np.arange(60)
    touch = (10.0 * t, np.where((t > 2.0) & (t < 2.6), 3.6, 3.4), 10.0)
    assert len(cut_in_events(table_of(touch))["frame"]) == 0


def test_without_neighbours_values_are_missing(tmp_path):
    t = 0.1 * np.arange(90)
    alone = cut_in_events(table_of((10.0 * t, 1.75 + np.clip(t - 2.0, 0.0, 3.5), 10.0)))
    assert (alone["ego"] == -1).all() and np.isnan(alone["gap_ego_cutin"]).all() and np.isnan(alone["v_lead"]).all()
    write_events(alone, tmp_path / "events.csv")
    with (tmp_path / "events.csv").open(encoding="utf-8") as file:
        assert [row["v_ego"] for row in csv.DictReader(file)] == ["", ""]
    assert len(concatenate_events([alone, alone])["ego"]) == 4


@needs_data
def test_recorded_events_are_those_behind_the_shipped_bases():
    """The shipped events were found scene by scene; here all scenes are one recording, so a few differ."""
    table = load_us101_trajectories(DATA)
    with (DATA / "us101_car_following_events.csv").open(encoding="utf-8") as file:
        shipped = {(int(row["ego"]), int(row["lead"])): row for row in csv.DictReader(file)}
    events = car_following_events(table)
    mine = {pair: i for i, pair in enumerate(zip(events["ego"].tolist(), events["lead"].tolist(), strict=True))}
    common = set(mine) & set(shipped)
    assert len(common) >= 465 and len(mine) <= 493
    same = [pair for pair in common if 100 * events["frame"][mine[pair]] == int(shipped[pair]["epoch_ms"])]
    assert len(same) >= 451
    apart = car_following_events(load_us101_trajectories(DATA, merged=False))
    assert len(set(zip(apart["ego"].tolist(), apart["lead"].tolist(), strict=True)) & set(shipped)) == 468
    for column in ("v_ego", "v_lead", "gap"):
        differences = [events[column][mine[pair]] - float(shipped[pair][column]) for pair in same]
        assert np.abs(differences).max() < 0.03

    with (DATA / "us101_cut_in_events.csv").open(encoding="utf-8") as file:
        rows = {(int(row["vehicle"]), int(row["to_lane"]), row["phase"]): row for row in csv.DictReader(file)}
    cuts = cut_in_events(table)
    keys = list(zip(cuts["vehicle"].tolist(), cuts["to_lane"].tolist(), cuts["phase"].tolist(), strict=True))
    assert set(rows) <= set(keys) and len(keys) == len(rows) + 4
    late = {key: cuts["frame"][i] - int(rows[key]["epoch_ms"]) // 100 for i, key in enumerate(keys) if key in rows}
    assert sum(value == 0 for key, value in late.items() if key[2] == "crossing") == 63
    assert sum(abs(value) <= 1 for key, value in late.items() if key[2] == "start") >= 61


@pytest.fixture(scope="module")
def simulated():
    return simulate(0, lanes=3, per_lane=14, seconds=22.0, changers=0.8)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 1)


def run_cli(*arguments):
    app = Typer()
    app.command()(fit_scenarios.main)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_bases_are_fitted_to_a_highd_folder(simulated, quick, tmp_path):
    write_highd(tmp_path / "highD", simulated, simulate(1, lanes=2, per_lane=6, seconds=12.0))
    result = run_cli("--highd", tmp_path / "highD", "--out", tmp_path / "bases", "--name", "cologne")
    assert result.exit_code == 0, result.output
    for scenario in EVENT_RECIPES:
        path = tmp_path / "bases" / f"{scenario}_cologne.json"
        points = load_base(scenario_named(scenario), path).sample(100, np.random.default_rng(0))
        assert np.isfinite(points).all()
        # simulated speeds are between 9 and 27 m/s
        assert 12.0 < points[:, 0].mean() < 25.0
        source = json.loads(path.read_text(encoding="utf-8"))["provenance"]["source"]
        assert source["data"] == "recordings 01-lower, 01-upper"


def test_bases_are_fitted_to_a_raw_ngsim_file(simulated, quick, tmp_path):
    write_ngsim(tmp_path / "us101.csv", simulated)
    assert run_cli("--ngsim", tmp_path / "us101.csv", "--out", tmp_path).exit_code == 0
    table = load_ngsim(tmp_path / "us101.csv")
    vehicles = cut_in_events(table)["vehicle"] - 1
    assert len(set(vehicles)) >= 8
    assert (simulated.changed[vehicles] >= 0).all()
    starts = cut_in_events(table)["phase"] == "start"
    began = simulated.changed[vehicles[starts]] / 5 + 11_188_469_800
    late = cut_in_events(table)["frame"][starts] - began
    assert (late > 0).all() and (late < 12).all()  # 0.2 m/s over 0.5 s is reached within a second

    scenes = scenes_of(table, seconds=5.0)
    assert {len(scene.x) for scene in scenes[:-1]} == {50}
    for scene in scenes:
        assert np.abs(scene.acceleration[scene.acted]).max() < 8.0
        assert (scene.lane_numbers()[scene.present] >= 0).all()
    states = sum(int(scene.present.sum()) for scene in scenes)
    assert states == len(table) - len(table.track_starts())  # the last position of a track has no speed


def test_scenes_follow_the_record_and_meet_where_they_were_cut(simulated, tmp_path):
    write_ngsim(tmp_path / "us101.csv", simulated)
    table = load_ngsim(tmp_path / "us101.csv")
    whole, *_ = scenes_of(table, seconds=1000.0)
    parts = scenes_of(table, seconds=4.0)
    first = parts[0]
    offset = round((first.start - whole.start) / 0.1)
    both = whole.present[offset : offset + len(first.x)]
    assert np.nansum(whole.x[offset : offset + len(first.x)][both]) == pytest.approx(np.nansum(first.x[first.present]))
    assert np.abs(np.sort(whole.speed[whole.present])).max() < 30.0


def test_what_scenes_need_is_named():
    table = cutting_in()
    columns = {name: table.column(name) for name in COLUMNS}
    with pytest.raises(ValueError, match=r"'r' has no lane boundaries.*y = 1\.8 to 5\.2 m.*lane 1 at 1\.8 m"):
        scenes_of(tabulate(columns))
    with pytest.raises(ValueError, match=r"nobody between its lane boundaries, -7 to 0 m; its vehicles are at y ="):
        scenes_of(tabulate(columns, {"r": (-7.0, -3.5, 0.0)}))
    with pytest.raises(ValueError, match="Scenes need width"):
        scenes_of(tabulate({name: table.column(name) for name in COLUMNS} | {"width": np.nan}))
    with pytest.raises(ValueError, match=r"scenes of 0\.4 s or more"):
        scenes_of(table, seconds=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "Give one of --data, --highd and --ngsim"),
        (("--highd", "none"), "has no files XX_tracks.csv"),
        (("--ngsim", "none.csv"), "Cannot read none.csv"),
        (("--ngsim", "none.csv", "--scenario", "merge"), "Unknown scenario merge"),
        (("--ngsim", "none.csv", "--data", "none"), "Give one of"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(arguments, message, tmp_path):
    result = run_cli(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
