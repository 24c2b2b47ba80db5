"""Base distributions from files: the shipped ones are repeated, and a user's own recordings are fitted."""

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import scenario_named
from tests.training.data.published_files import (
    CLOCK,
    coifman_matrix,
    i24_documents,
    tgsim_rows,
    write_coifman,
    write_i24,
    write_tgsim,
)
from tests.training.data.recordings import simulate, write_highd, write_ngsim
from tests.training.data.stopping_traffic import PAUSE, stopping_traffic
from tests.training.shared_data import DATA, needs_data
from training.data.brakings import braking_exposure
from training.data.events import cut_in_events
from training.data.formats import load_ngsim
from training.data.scenes import scenes_of
from training.scenario_fitting import fit as fit_scenarios
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.coordinate_systems import BIC_TIE
from training.scenario_fitting.fit import fit_own_bases, fit_shipped_base
from training.scenario_fitting.shipped.bases import SHIPPED_BASES

MOVING = ("car_following", "cut_in")
"""Scenarios of which `simulate` makes events: nobody stops in it."""


@pytest.fixture(scope="module")
def simulated():
    return simulate(0, lanes=3, per_lane=14, seconds=22.0, changers=0.8)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 1)


def run_cli(*arguments):
    app = Typer()
    app.command()(fit_scenarios.main)
    return CliRunner().invoke(app, [str(a) for a in (*arguments, "--refits", 2)])


def shipped(name):
    return json.loads((resources.files("rare_envs") / "data" / name).read_text(encoding="utf-8"))


def test_bases_are_fitted_to_a_highd_folder(simulated, quick, tmp_path):
    write_highd(tmp_path / "highD", simulated, simulate(1, lanes=2, per_lane=6, seconds=12.0))
    result = run_cli("--highd", tmp_path / "highD", "--out", tmp_path / "bases", "--name", "cologne")
    assert result.exit_code == 0, result.output
    assert "hard_brake_events.csv: 0 events are too few" in result.stderr  # nobody stops
    assert not (tmp_path / "bases" / "hard_brake_cologne.json").exists()
    for scenario in MOVING:
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


def check_bases(folder, scenarios=MOVING):
    """Bases of simulated traffic, whose speeds are between 9 and 27 m/s."""
    for scenario in scenarios:
        base = load_base(scenario_named(scenario), folder / f"{scenario}_own.json")
        points = base.sample(100, np.random.default_rng(0))
        assert np.isfinite(points).all() and 12.0 < points[:, 0].mean() < 25.0


def test_bases_are_fitted_to_a_folder_of_tgsim(simulated, quick, tmp_path):
    folder = tmp_path / "tgsim"
    folder.mkdir()
    write_tgsim(folder / "I294_L1.csv", tgsim_rows(simulated, radius=900.0, angle=2.6))
    (folder / "geometry.csv").write_text("x1,y1\n1,2\n", encoding="utf-8")
    result = run_cli("--tgsim", folder, "--out", tmp_path / "bases")
    assert result.exit_code == 0, result.output
    check_bases(tmp_path / "bases")
    provenance = json.loads((tmp_path / "bases" / "cut_in_own.json").read_text(encoding="utf-8"))["provenance"]
    assert provenance["source"]["data"] == "recordings I294_L1-1-left"


def test_bases_are_fitted_to_a_file_of_i24_motion(simulated, quick, tmp_path):
    path = write_i24(tmp_path / "morning.json", i24_documents(simulated))
    result = run_cli("--i24", path, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    check_bases(tmp_path)
    result = run_cli("--i24", path, "--out", tmp_path, "--between", CLOCK - 20.0, CLOCK - 10.0)
    assert result.exit_code == 2 and "has no rows between the times" in result.stderr


def test_where_no_base_can_be_fitted_the_error_names_all_of_them(simulated, quick, tmp_path):
    path = write_i24(tmp_path / "morning.json", i24_documents(simulated))
    result = run_cli("--i24", path, "--out", tmp_path, "--between", CLOCK, CLOCK + 2.0)
    assert result.exit_code == 2
    end = "No base of car_following, cut_in, hard_brake is written: give more recordings."
    assert result.stderr.splitlines()[-1].endswith(end)


def test_a_car_following_base_is_fitted_to_the_data_of_coifman_and_li(simulated, quick, tmp_path):
    path = write_coifman(tmp_path / "CoifmanAndLi2017.mat", coifman_matrix(simulated))
    result = run_cli("--coifman", path, "--out", tmp_path, "--scenario", "car_following")
    assert result.exit_code == 0, result.output
    check_bases(tmp_path, ("car_following",))
    result = run_cli("--coifman", path, "--out", tmp_path, "--scenario", "cut_in")  # no lateral offset
    read, events, error = result.stderr.splitlines()  # two of progress, one of the error
    assert result.exit_code == 2 and "too few" in error
    assert "rows read" in read and events == "cut_in: 17 events; fitting"


def test_a_hard_brake_base_is_fitted_to_brakings_to_a_standstill(quick, tmp_path):
    """The recipe of the shipped base: filters, refits of half-minutes, checks and frequency in one file."""
    rng = np.random.default_rng(4)
    n = 40
    speeds, decelerations = rng.uniform(8.0, 16.0, n), np.exp(rng.normal(np.log(2.0), 0.25, n))
    table = stopping_traffic(speeds, np.exp(rng.normal(np.log(12.0), 0.4, n)), decelerations)
    fit_own_bases([table], ["hard_brake"], tmp_path, "stops", n_refits=3)
    base = load_base(scenario_named("hard_brake"), tmp_path / "hard_brake_stops.json")
    assert base.events.used == (n,) and base.events.cluster == "half-minute"
    assert base.events.clusters == len(np.unique((400 * np.arange(n) + PAUSE - 8) // 300))
    assert len(base.refits) == 3
    points = base.sample(2000, np.random.default_rng(0))
    for column, recorded in ((0, speeds), (2, decelerations)):
        assert points[:, column].mean() == pytest.approx(recorded.mean(), rel=0.12)
    assert base.frequency.count == n
    seconds, metres = braking_exposure(table)
    assert base.frequency.per_hour == pytest.approx(3600 * n / seconds, rel=1e-3)
    assert base.frequency.per_km == pytest.approx(1000 * n / metres, rel=1e-3)
    assert [check.name for check in base.checks] == ["time headway < 0.5 s", "deceleration > 3 m/s^2", "gap < 3 m"]
    selection = base.record["selection"]
    assert [each["coordinates"] for each in selection] == ["plain", "log gap", "log gap, log deceleration"]
    dropped = {rule["rule"]: rule["dropped"] for rule in base.record["filters"] if rule.get("dropped")}
    assert dropped == {"gap is given": n}  # the leaders


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "Expected one of --data, --ngsim, --highd, --tgsim, --i24 and --coifman, with a path"),
        (("--highd", "none"), "There is no folder none; expected the data folder of highD"),
        (("--highd", str(Path(__file__).parent)), "has no files XX_tracks.csv"),
        (("--ngsim", "none.csv"), "Cannot read none.csv"),
        (("--tgsim", "none"), "none has no CSV file with a column xloc_kf"),
        (("--i24", "none.json"), "Cannot read none.json"),
        (("--coifman", "none.mat"), "Cannot read none.mat"),
        (("--ngsim", "none.csv", "--scenario", "merge"), "Unknown scenario merge"),
        (("--ngsim", "none.csv", "--data", "none"), "Expected one of"),
        (("--ngsim", "none.csv", "--name", "a/b"), "part of file names, such as cologne, got 'a/b'"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(arguments, message, tmp_path):
    result = run_cli(*arguments, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_bad_data_folder_is_one_line_and_exit_code_2(tmp_path):
    result = run_cli("--data", tmp_path / "none", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "Cannot read events from" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("base", SHIPPED_BASES, ids=lambda base: f"{base.scenario}-{base.name}")
def test_shipped_files_say_what_they_are_worth(base):
    file = shipped(base.file)
    record = file["provenance"]
    assert {"site", "data", "licence", "moment"} <= set(record["source"])
    least = min(s["bic"] for s in record["selection"])
    own = next(s for s in record["selection"] if s["coordinates"] == record["coordinates"])
    assert record["bic"] == own["bic"]
    chosen = min((c for c in own["components"] if c["accepted"]), key=lambda c: c["bic"])
    assert chosen["number"] == len(file["weights"])
    assert record["coordinates"].startswith(base.system or " ") or own["bic"] <= least + BIC_TIE
    fitted = load_base(scenario_named(base.scenario), base.name)
    families = {(len(refit.weights), refit.coordinates.kinds) for refit in fitted.refits}
    assert len(fitted.refits) == (30 if len(families) == 1 else 100)
    kinds = {kinds for _, kinds in families}
    assert ("; of the refits" in file["family"]) == (len(kinds) > 1)
    assert base.system is None or kinds == {fitted.distribution.coordinates.kinds}
    assert (fitted.frequency is None) == ("no_frequency" in record["source"])


def test_the_offset_of_a_cut_in_is_fitted_apart():
    base = load_base(scenario_named("rare_envs/CutIn-v0"), "us101-15-offsets")
    assert base.events.used == (38, 15)
    covariance = np.array(base.distribution.covariances[0])
    assert (covariance[5, :5] == 0.0).all()
    assert (covariance[:5, :5] != 0.0).all()


@needs_data("us101_cut_in_events.csv", "lane_change_profiles.parquet")
@pytest.mark.parametrize(
    "base",
    [pytest.param(b, marks=pytest.mark.slow if b.scenario == "car_following" else ()) for b in SHIPPED_BASES],
    ids=lambda base: f"{base.scenario}-{base.name}",
)
def test_fit_of_the_recorded_events_is_the_shipped_file(base):
    """Up to the last digits, which other library versions may round differently; two of the refits."""
    written, expected = json.loads(fit_shipped_base(base, DATA, n_refits=2)), shipped(base.file)
    for one, other in [(written, expected), *zip(written.pop("refits"), expected.pop("refits")[:2], strict=True)]:
        for key in ("weights", "means", "covariances"):
            np.testing.assert_allclose(one.pop(key), other.pop(key), rtol=1e-4, atol=1e-4)
    new, old = written.pop("provenance"), expected.pop("provenance")
    one, other = (each.pop("family").split(";")[0] for each in (written, expected))  # behind it are counts of refits
    assert one == other
    assert written == expected
    assert new["bic"] == pytest.approx(old["bic"], abs=0.1)
    for key in ("source", "filters", "settings", "command", "coordinates"):
        assert new[key] == old[key]
