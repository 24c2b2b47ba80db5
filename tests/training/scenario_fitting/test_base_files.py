"""Base files: what a fit leaves out of the box, what its record says, and that the file is read back as it was."""

import json

import numpy as np
import pytest

from rare_envs.distributions.coordinates import ClosingSpeed, Coordinates
from rare_envs.distributions.fitted import EventFrequency
from rare_envs.distributions.mixture import CoordinateMixture
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import scenario_named
from training.scenario_fitting import mixture as mixture_fit
from training.scenario_fitting.base_files import FitRequest, fit_base, format_base, mass_outside
from training.scenario_fitting.event_filters import EventSet

FREQUENCY = EventFrequency(count=60, hours=6.0, km=200.0, definition="a pair begins", source="made up")
SOURCE = {"site": "nowhere", "data": "made up", "licence": "none"}


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(mixture_fit, "EM_STARTS", 1)


def request(n=60, **changes):
    rng = np.random.default_rng(0)
    x = np.column_stack([rng.normal(15.0, 3.0, (n, 2)), np.exp(rng.normal(3.0, 0.4, n))])
    events = EventSet(x, np.arange(n) // 4, cluster="scene")
    return FitRequest("car_following", events, SOURCE, "by hand", FREQUENCY, n_refits=3, **changes)


def test_mass_outside_of_a_known_box():
    plain = Coordinates([-1.0, -9.0], [9.0, 9.0], ("plain", "plain"))
    mass = mass_outside(CoordinateMixture(plain, [1.0], [[0.0, 0.0]], [np.eye(2)]))
    assert abs(mass["any"] - 0.15865525) < 4.0 * mass["standard_error"]
    assert mass["each"] == pytest.approx([0.15865525, 0.0], abs=2e-3)


def test_mass_outside_of_a_closing_speed():
    """Speed 10, gap e^2, closing speed N(0, 1) e: ahead below 0 where the closing speed is above 10 / e."""
    closing = Coordinates(
        low=[0.0, 0.0, 1.0],
        high=[45.0, 45.0, 150.0],
        kinds=("plain", ClosingSpeed("v", "gap"), "log"),
        names=("v", "ahead", "gap"),
        order=("v", "gap", "ahead"),
    )
    tight = np.diag([1e-12, 1e-12, 9.0])
    mass = mass_outside(CoordinateMixture(closing, [1.0], [[10.0, 2.0, 0.0]], [tight]))
    expected = 0.1100  # Phi(-10 / (3 e)); 35 m/s faster has probability 1e-5
    assert mass["each"][1] == pytest.approx(expected, abs=4.0 * mass["standard_error"] + 1e-4)


def test_a_base_carries_all_that_says_what_it_is_worth(quick):
    base = fit_base(request())
    assert len(base.refits) == 3
    assert (base.events.used, base.events.clusters, base.events.cluster) == ((60,), 15, "scene")
    assert base.frequency == FREQUENCY
    assert [check.name for check in base.checks] == ["TTC < 5 s", "needed deceleration > 1 m/s^2", "gap < 3 m"]
    selection = base.record["selection"]
    assert [entry["coordinates"] for entry in selection][:2] == ["plain", "log gap"]
    own = next(entry for entry in selection if entry["coordinates"] == base.record["coordinates"])
    assert base.record["bic"] == own["bic"] == min(c["bic"] for c in own["components"] if c["accepted"])


def test_the_file_is_read_back(quick):
    base = fit_base(request(system="log gap"))
    text = format_base("car_following", base.to_dict())
    data = json.loads(text)
    assert data["names"] == ["ego_speed", "lead_speed", "gap"]
    assert data["units"] == ["m/s", "m/s", "m"]


def test_the_file_gives_the_same_distribution(quick, tmp_path):
    base = fit_base(request())
    path = tmp_path / "car_following_own.json"
    path.write_text(format_base("car_following", base.to_dict()), encoding="utf-8")
    again = load_base(scenario_named("car_following"), path)
    x = base.sample(100, np.random.default_rng(0))
    assert np.array_equal(base.log_prob(x), again.log_prob(x))
    written, read = base.to_dict(), again.to_dict()
    assert {**written, "names": read.get("names")} == {**read, "names": read.get("names")}  # a file always has them
    for one, other in zip(base.refits, again.refits, strict=True):
        assert np.array_equal(one.log_prob(x), other.log_prob(x))


@pytest.mark.parametrize("logarithmic", [True, False])
def test_the_coordinate_of_the_duration_is_chosen_by_the_changes(quick, logarithmic):
    """Durations of 200 changes, normal or log-normal with the same mean and a coefficient of variation of 0.4."""
    rng = np.random.default_rng(3)
    joint = np.column_stack([rng.normal(15.0, 2.0, (40, 3)), rng.uniform(5.0, 40.0, (40, 2))])
    normal = rng.standard_normal(200)
    duration = np.exp(np.log(5.0) - 0.08 + 0.39 * normal) if logarithmic else 5.0 + 1.2 * normal
    events = EventSet(joint, np.arange(40), np.column_stack([rng.normal(3.2, 0.2, 200), np.clip(duration, 1.6, 11.9)]))
    base = fit_base(FitRequest("cut_in", events, {}, "a test", n_refits=2))
    word = "log duration" if logarithmic else "plain duration"
    assert base.family.endswith(f", {word}") and base.record["coordinates"].endswith(f", {word}")
    selection = base.record["selection_apart"]
    assert [each["coordinates"] for each in selection] == ["plain duration", "log duration"]
    assert min(selection, key=lambda each: each["bic"])["coordinates"] == word
    assert base.events.used == (40, 200)
    assert {refit.coordinates.kinds[6] for refit in base.refits} == {"log" if logarithmic else "plain"}


def test_a_coordinate_system_by_name(quick):
    assert fit_base(request(system="plain")).family.endswith("plain")
    with pytest.raises(ValueError, match="Unknown coordinate system 'polar'; known are plain, log gap, closing"):
        fit_base(request(system="polar"))
