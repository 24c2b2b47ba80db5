"""The human driver model and its glances."""

import math
from typing import Any

import numpy as np
import pytest
import torch

from rare_envs.control.human_driver import (
    GLANCE_CDF,
    LAMBLE_AT_20_M,
    LAMBLE_AT_40_M,
    LAMBLE_ECCENTRICITIES,
    MEAN_GLANCE,
    MEAN_ON_ROAD,
    NOBODY,
    OFF_ROAD_SHARE,
    Ahead,
    Glances,
    HumanDriverModel,
    count_glance_draws,
    draw_glances,
    estimate,
    evasive_steps,
    expansion_rate,
    find_ahead,
    remaining_duration,
    respond,
    seen_expansion_rate,
    steer_along,
    step_errors,
)
from rare_envs.control.idm import IDM
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import STANDARD_GRAVITY, State, bicycle
from tests.rare_envs.traffic_states import F64, tensor

MODEL = HumanDriverModel()


def test_errors_have_variance_one_and_the_published_correlation_time() -> None:
    generator = torch.Generator().manual_seed(0)
    n, dt, tau = 100_000, 0.5, 20.0
    first = errors = torch.randn(n, generator=generator, dtype=F64)
    for step in range(1, 41):
        errors = step_errors(errors, torch.randn(n, generator=generator, dtype=F64), dt, tau)
        if step in (1, 10, 40):
            assert float(errors.std()) == pytest.approx(1.0, abs=5 / math.sqrt(2 * n))
            kept = float((first * errors).mean())
            assert kept == pytest.approx(math.exp(-step * dt / tau), abs=5 * math.sqrt(2 / n))
    assert kept == pytest.approx(math.exp(-1.0), abs=0.02)  # after the correlation time


def test_gap_and_speed_difference_are_misjudged_as_published() -> None:
    ahead = Ahead(tensor(20.0, NOBODY), tensor(12.0, 3.0), tensor(0.0, 0.0))
    lead = estimate(ahead, tensor(15.0, 15.0), tensor(1.0, -2.0)[None], MODEL)
    assert lead.gap.tolist() == pytest.approx([20.0 * math.exp(0.1), NOBODY * math.exp(0.1)])
    assert lead.closing_speed[0].item() == pytest.approx(3.0 - 2.0 * 0.01 * 20.0)


def test_the_nearest_that_is_noticed_and_ahead_is_followed() -> None:
    x, speed = tensor(0.0, 60.0, 30.0, 20.0, -4.0)[None], tensor(15.0, 12.0, 10.0, 9.0, 8.0)[None]
    state = State(x, 0 * x, 0 * x, speed, x[:, :0])
    noticed, before = torch.tensor([[True, True, False, True]]), speed[:, 1:] + 0.2
    ahead = find_ahead(state, noticed, before, 0.1)
    assert [each.item() for each in ahead] == pytest.approx([25.0, 10.0, -2.0])
    assert find_ahead(state, noticed & (x[:, 1:] < 0.0), before, 0.1).gap.item() > 1e6


def test_a_lead_is_braked_for_by_the_heuristic_until_its_braking_is_seen() -> None:
    """v = 20 m/s, 10 m behind 18 m/s: improved IDM 1 - 3.83^2, at most 0.774 g; heuristic -2^2 / 20, see `idm`."""
    model = HumanDriverModel(idm=IDM(1e3, 1.0, 1.0, 1.5, jam_distance=2.0, jam_distance_speed=0.0, cut_off=True))
    lead, speed = Lead(tensor(10.0), tensor(2.0)), tensor(20.0)
    improved = 1 - ((2 + 20 + 20 * 2 / (2 * math.sqrt(1.5))) / 10) ** 2
    for lead_acceleration, heuristic in ((0.0, -0.2), (1.0, -0.2), (-0.49, -0.49 - 0.2)):
        expected = 0.01 * improved + 0.99 * (heuristic + 1.5 * math.tanh((improved - heuristic) / 1.5))
        found = respond(lead, tensor(lead_acceleration), speed, model).item()
        assert found == pytest.approx(expected, abs=1e-9)
    assert respond(lead, tensor(-0.51), speed, model).item() == -5.0


def test_a_driver_with_nobody_ahead_accelerates_freely_whatever_its_errors() -> None:
    """a (1 - (v / v0)^4), with a slope in the errors that is 0 and no NaN."""
    errors = tensor(3.0, -3.0)[None].requires_grad_()
    lead = estimate(Ahead(tensor(NOBODY), tensor(40.0), tensor(-9.0)), tensor(20.0), errors, MODEL)
    acceleration = respond(lead, tensor(0.0), tensor(20.0), MODEL)
    assert acceleration.item() == pytest.approx(1 - (20 / (120 / 3.6)) ** 4, abs=1e-9)
    assert torch.autograd.grad(acceleration, errors)[0].abs().max().item() < 1e-9


def test_a_standing_lead_is_not_run_into() -> None:
    """Behind a lead that stands, from 15 m/s and 60 m: the heuristic alone stops with constant -15^2 / 120."""
    model = HumanDriverModel(coolness=1.0)
    gap, speed = tensor(60.0), tensor(15.0)
    while speed > 0.1:
        acceleration = respond(Lead(gap, speed), tensor(0.0), speed, model)
        gap, speed = gap - speed * 0.01, (speed + acceleration * 0.01).clamp(min=0.0)
    assert 0.0 < gap.item() < 5.0


def test_longer_reaction_times_are_warned_of() -> None:
    with pytest.warns(UserWarning, match="this model of braking is wrong"):
        HumanDriverModel(reaction_time=0.8)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((name, 1.1) for name in ("coolness", "evasive_share")),
        *((name, 0.0) for name in ("error_correlation", "jerk", "evasive_acceleration")),
        *((name, math.inf) for name in ("reaction_time", "noticing_time", "error_correlation", "glance_ttc")),
        *((name, -0.1) for name in ("gap_error", "approach_error", "wandering", "brake_light", "glance_looming")),
        ("glance_eccentricity", 181.0),
        ("evasive_distance", math.nan),
        ("evasive_reach", "1 m"),
    ],
)
def test_a_driver_that_cannot_be_is_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^Expected {name} of the human driver to be a number .*, got {value!r}\\.$"):
        HumanDriverModel(**{name: value})


@pytest.mark.parametrize("gap", [5.0, 20.0, 40.0, 200.0])
def test_looming_is_seen_from_the_published_rates_on(gap: float) -> None:
    table = LAMBLE_AT_20_M if gap <= 20.0 else LAMBLE_AT_40_M
    found = [seen_expansion_rate(tensor(gap), eccentricity).item() for eccentricity in LAMBLE_ECCENTRICITIES]
    assert found == pytest.approx(table, rel=1e-12)
    halfway = seen_expansion_rate(tensor(20.0 * math.sqrt(2.0)), 34.0).item()
    assert halfway == pytest.approx((0.00646 + 0.00739 + 0.00498 + 0.00710) / 4, rel=1e-12)
    assert seen_expansion_rate(tensor(gap), 90.1).item() == math.inf


@pytest.mark.parametrize(("eccentricity", "distance", "left"), [(0, 20, 6), (0, 40, 8), (90, 20, 4), (90, 40, 4)])
def test_the_rates_leave_the_time_that_their_authors_tell(eccentricity: int, distance: int, left: int) -> None:
    """Lamble et al.'s abstract: the lead slows down by 0.7 m/s^2, so that contact is after sqrt(2 x distance / 0.7)."""
    t = torch.arange(0.0, math.sqrt(2 * distance / 0.7), 0.01, dtype=F64)
    rate = expansion_rate(distance - 0.35 * t**2, 0.7 * t)
    seen = rate >= seen_expansion_rate(tensor(float(distance)), float(eccentricity))
    assert round(math.sqrt(2 * distance / 0.7) - t[seen][0].item()) == left


def test_the_expansion_rate_is_the_slope_of_the_angle_of_sight() -> None:
    gap, closing, dt = 12.0, 3.0, 1e-6
    angle = [2 * math.atan(0.9 / (gap - closing * t)) for t in (-dt, dt)]
    assert expansion_rate(tensor(gap), tensor(closing)).item() == pytest.approx((angle[1] - angle[0]) / (2 * dt))


@pytest.mark.parametrize("speed", [6.0, 15.0, 30.0])
def test_the_bicycle_model_moves_a_metre_aside_with_the_acceleration_of_the_manoeuvre(speed: float) -> None:
    """One metre with 0.4 g there and back takes 2 sqrt(1 / 0.4 g) = 1.01 s, 0.99 m/s faster and slower again each."""
    limit, dt = 0.4 * STANDARD_GRAVITY, 0.1
    steps = evasive_steps(1.0, limit, dt)
    assert len(steps) == math.ceil(2 * math.sqrt(1.0 / limit) / dt)
    x, y, heading, v = tensor(0.0), tensor(0.0), tensor(0.0), tensor(speed)
    places = [0.0, 0.0]
    for way in (*steps, 0.0, 0.0, 0.0):
        steering = steer_along(tensor(way), heading, v, dt)
        x, y, heading, v = bicycle(x, y, heading, v, tensor(0.0), steering, dt)
        places.append(y.item())
    across = np.diff(places, 2) / dt**2
    assert places[-1] == pytest.approx(1.0, abs=1e-9)
    assert np.abs(across).max() == pytest.approx(limit, rel=0.1)
    assert np.abs(across).max() <= limit * (1 + 1e-9)
    assert abs(heading.item()) < 0.05


N, HORIZON = 40_000, 10.0


@pytest.fixture(scope="module")
def glances() -> Glances:
    generator = torch.Generator().manual_seed(0)
    return draw_glances(torch.randn(N, count_glance_draws(HORIZON), generator=generator, dtype=torch.float64))


def test_durations_have_the_published_distribution(glances: Glances) -> None:
    lasting = (glances.end - glances.start)[:, 1]
    for duration, share in GLANCE_CDF:
        found = float((lasting <= duration).double().mean())
        assert abs(found - share) < 5 * math.sqrt(share * (1 - share) / N) + 1e-12
    assert float(lasting.mean()) == pytest.approx(MEAN_GLANCE, rel=0.02)
    assert pytest.approx(0.863, abs=0.005) == MEAN_GLANCE  # of the counts, without interpolation


def test_the_eyes_are_off_the_road_for_the_published_share_at_all_times(glances: Glances) -> None:
    for time in (0.0, 0.5, 3.0, 9.9):
        share = float(glances.off_road(time).double().mean())
        assert abs(share - OFF_ROAD_SHARE) < 5 * math.sqrt(OFF_ROAD_SHARE / N)
    assert MEAN_GLANCE / (MEAN_GLANCE + MEAN_ON_ROAD) == pytest.approx(OFF_ROAD_SHARE)


def test_what_is_left_of_a_glance_is_that_of_a_stationary_sequence(glances: Glances) -> None:
    """By the sequence itself: at 5 s, long after its beginning, the rest of a glance that is under way."""
    under_way = (glances.start <= 5.0) & (5.0 < glances.end) & (glances.start > 0.0)
    left = (glances.end - 5.0)[under_way].numpy()
    shares = np.array([0.1, 0.5, 0.9])
    expected = remaining_duration(torch.from_numpy(shares)).numpy()
    found = np.array([(left <= each).mean() for each in expected])
    assert (np.abs(found - shares) < 5 * np.sqrt(shares * (1 - shares) / len(left))).all()
