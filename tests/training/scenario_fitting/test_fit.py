"""Fitting base distributions: known truth, determinism, filters, and the shipped files."""

import csv
import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from typer import Typer
from typer.testing import CliRunner

from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture
from rare_envs.scenarios.registry import scenario_named
from training.scenario_fitting import fit as fit_scenarios
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.event_filters import EVENT_RECIPES, filter_events, read_events
from training.scenario_fitting.fit import fit_us101_base, format_base
from training.scenario_fitting.mixture import COVARIANCE_FLOOR, SMALLEST_COMPONENT, mass_outside, select_mixture
from training.scenario_fitting.published_highway import build_highway_base

DATA = Path(__file__).parents[4] / "shared" / "data"
needs_data = pytest.mark.skipif(
    not (DATA / EVENT_RECIPES["cut_in"].file).is_file(),
    reason=f"recorded traffic is not part of the repository: {DATA} is absent",
)

TRUTH = TruncatedGaussianMixture(
    [0.65, 0.35],
    [[10.0, 5.0], [20.0, 12.0]],
    [[[4.0, 1.5], [1.5, 2.0]], [[2.0, -0.6], [-0.6, 1.0]]],
    [-20.0, -20.0],
    [50.0, 50.0],
)


@pytest.fixture
def quick(monkeypatch):
    """Fewer starts: enough for well separated clusters."""
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 2)


def fit_truth(n, seed=0):
    points = TRUTH.sample(n, np.random.default_rng(1))
    return select_mixture(points, TRUTH.low, TRUTH.high, seed)


def test_fit_recovers_a_known_mixture(quick):
    n = 2000
    fit = fit_truth(n)
    law = fit.mixture
    assert len(law.weights) == 2
    assert abs(law.weights[0] - 0.65) < 4.0 * np.sqrt(0.65 * 0.35 / n)
    counts = n * TRUTH.weights
    for k in range(2):
        variance = np.diag(TRUTH.covariances[k])
        assert (np.abs(law.means[k] - TRUTH.means[k]) < 4.0 * np.sqrt(variance / counts[k])).all()
        # Sampling error of a covariance, and the floor: 1 % of the overall variance.
        error = 4.0 * np.sqrt(2.0 / counts[k]) * np.sqrt(np.outer(variance, variance))
        floor = COVARIANCE_FLOOR * np.diag([30.0, 15.0])
        assert (np.abs(law.covariances[k] - TRUTH.covariances[k]) < error + floor).all()


def test_fit_is_deterministic(quick):
    assert fit_truth(300).mixture.to_dict() == fit_truth(300).mixture.to_dict()


def test_a_component_on_a_handful_of_events_is_rejected(quick):
    rng = np.random.default_rng(0)
    few = 2 * SMALLEST_COMPONENT - 4
    far = np.array([60.0, 60.0]) + 0.01 * rng.standard_normal((few, 2))
    points = np.concatenate([rng.standard_normal((200, 2)), far])
    fit = select_mixture(points, np.full(2, -99.0), np.full(2, 99.0))
    second = fit.candidates[1]
    assert second.smallest == pytest.approx(few)
    assert second.bic < fit.candidates[0].bic
    assert not second.accepted
    chosen = min((c for c in fit.candidates if c.accepted), key=lambda c: c.bic)
    assert len(fit.mixture.weights) == chosen.components


def test_few_events_get_one_component_and_too_few_an_error():
    points = np.random.default_rng(0).standard_normal((15, 6))
    assert len(select_mixture(points, np.full(6, -9.0), np.full(6, 9.0)).candidates) == 1
    with pytest.raises(ValueError, match="6 events are too few to fit 6 parameters"):
        select_mixture(points[:6], np.full(6, -9.0), np.full(6, 9.0))
    points[:, 2] = 1.0
    with pytest.raises(ValueError, match="Parameter 2 is the same in all 15 events"):
        select_mixture(points, np.full(6, -9.0), np.full(6, 9.0))


def test_mass_outside_of_a_known_box():
    law = TruncatedGaussianMixture([1.0], [[0.0, 0.0]], [np.eye(2)], [-1.0, -9.0], [9.0, 9.0])
    mass = mass_outside(law)
    assert abs(mass["any"] - 0.15865525) < 4.0 * mass["standard_error"]
    assert mass["each"] == pytest.approx([0.15865525, 0.0], abs=1e-3)


def write_events(path, rows):
    columns = ["phase", *EVENT_RECIPES["cut_in"].columns, "start_seen"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(rows)


GOOD = [15.0, 14.0, 16.0, 12.0, 20.0, 3.0]


def test_filters_drop_and_count(tmp_path):
    path = tmp_path / EVENT_RECIPES["cut_in"].file
    write_events(
        path,
        [
            ["start", *GOOD, True],
            ["crossing", *GOOD, True],
            ["start", *GOOD, False],
            ["start", "", *GOOD[1:], True],  # no ego
            ["start", *GOOD[:3], -2.0, *GOOD[4:], True],  # side by side
            ["start", *GOOD[:5], 1.5, True],  # bodies overlap across
            ["start", 16.0, *GOOD[1:], True],
        ],
    )
    recipe, box = EVENT_RECIPES["cut_in"], scenario_named("cut_in").parameters
    (points, offsets), log = filter_events(read_events(path, recipe), recipe, box)
    # speeds and gaps count even where the offset at the start was not seen or is out of range
    assert points.tolist() == [GOOD[:5], GOOD[:5], GOOD[:5], [16.0, *GOOD[1:5]]]
    assert offsets.tolist() == [[3.0], [3.0]]
    assert log[0]["events"] == 6
    assert [entry["events"] for entry in log if entry["rule"] == "events used"] == [4, 2]
    dropped = {entry["rule"]: entry["dropped"] for entry in log if entry.get("dropped")}
    assert dropped == {
        "v_ego is given": 1,
        "start_seen": 1,
        "1 <= gap_ego_cutin <= 120 m": 1,
        "2.2 <= lateral_offset <= 5 m": 1,
    }


def run_cli(*arguments):
    app = Typer()
    app.command()(fit_scenarios.main)
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_bad_data_folder_is_one_line_and_exit_code_2(tmp_path):
    result = run_cli("--data", tmp_path / "none", "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "Cannot read events from" in result.stderr
    assert "Traceback" not in result.stderr
    assert not (tmp_path / "out").exists()


def test_missing_column_is_named(tmp_path):
    path = tmp_path / "events.csv"
    path.write_text("v_ego,v_lead\n1,2\n", encoding="utf-8")
    with pytest.raises(ValueError, match="lacks the columns gap"):
        read_events(path, EVENT_RECIPES["car_following"])


def shipped(name):
    return json.loads((resources.files("rare_envs") / "data" / name).read_text(encoding="utf-8"))


@pytest.mark.parametrize("scenario", EVENT_RECIPES)
def test_highway_files_are_what_the_script_writes(scenario):
    written = json.loads(format_base(scenario, *build_highway_base(scenario)))
    assert written == shipped(f"{scenario}_highway.json")
    assert "NOT fitted" in written["provenance"]["kind"]


@pytest.mark.parametrize("scenario", EVENT_RECIPES)
def test_fitted_files_say_where_they_come_from(scenario):
    provenance = shipped(f"{scenario}_us101.json")["provenance"]
    assert provenance["source"]["record"] == "8ect-6jqj"
    assert "CC BY-SA 3.0" in provenance["source"]["licence"]
    dropped = sum(entry["dropped"] for entry in provenance["filters"])
    assert provenance["events_read"] - dropped == min(provenance["events_used"].values())
    best = min((c for c in provenance["selection"] if c["accepted"]), key=lambda c: c["bic"])
    assert best["components"] == len(shipped(f"{scenario}_us101.json")["weights"])


def test_the_offset_of_a_cut_in_is_fitted_apart():
    file = shipped("cut_in_us101.json")
    assert list(file["provenance"]["events_used"].values()) == [38, 15]
    assert file["logarithmic"] == [False, False, False, True, True, False]
    covariance = np.array(file["covariances"][0])
    assert (covariance[5, :5] == 0.0).all()
    assert (covariance[:5, :5] != 0.0).all()


@needs_data
@pytest.mark.parametrize("scenario", [pytest.param("car_following", marks=pytest.mark.slow), "cut_in"])
def test_fit_of_the_recorded_events_is_the_shipped_file(scenario):
    """Up to the last digits, which other library versions may round differently."""
    written = json.loads(fit_us101_base(scenario, DATA))
    expected = shipped(f"{scenario}_us101.json")
    for key in ("weights", "means", "covariances"):
        np.testing.assert_allclose(written.pop(key), expected.pop(key), rtol=1e-4, atol=1e-4)
    new, old = written.pop("provenance"), expected.pop("provenance")
    assert written == expected
    for key in ("source", "filters", "events_read", "events_used", "settings", "command"):
        assert new[key] == old[key]
    # The best fits agree; those that were not chosen may have stopped at another local optimum.
    assert [c["components"] for c in new["selection"]] == [c["components"] for c in old["selection"]]
    best = [min(c["bic"] for c in p["selection"] if c["accepted"]) for p in (new, old)]
    assert best[0] == pytest.approx(best[1], abs=0.1)
