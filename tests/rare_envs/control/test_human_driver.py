"""The human driver model and its glances."""

import math

import numpy as np
import pytest
import torch

from rare_envs.control.human_driver import (
    GLANCE_CDF,
    MEAN_GLANCE,
    MEAN_ON_ROAD,
    OFF_ROAD_SHARE,
    Glances,
    HumanDriverModel,
    Percept,
    count_glance_draws,
    draw_glances,
    estimate_leads,
    remaining_duration,
    respond,
    step_errors,
)
from rare_envs.control.idm import IDM
from rare_envs.traffic.bodies import Lead
from tests.rare_envs.traffic_states import F64, tensor

MODEL = HumanDriverModel()
NO_ERRORS = torch.zeros(1, 2, dtype=F64)


def percept(*vehicles: tuple[float, float, bool]) -> Percept:
    """One scenario; distance of centres, speed, noticed."""
    distance, speed, noticed = zip(*vehicles, strict=True)
    return Percept(tensor(*distance)[None], tensor(*speed)[None], torch.tensor([noticed]))


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
    lead = estimate_leads(percept((25.0, 12.0, True)), tensor(15.0), tensor(1.0, -2.0)[None], MODEL)
    assert lead.gap.item() == pytest.approx(20.0 * math.exp(0.1))
    assert lead.closing_speed.item() == pytest.approx(3.0 - 2.0 * 0.01 * 20.0)


def test_gaps_to_several_leaders_leave_out_the_bodies_in_between() -> None:
    others = percept((60.0, 10.0, True), (20.0, 12.0, True), (-20.0, 15.0, True), (30.0, 15.0, False))
    lead = estimate_leads(others, tensor(15.0), NO_ERRORS, MODEL)
    assert lead.gap.tolist() == [[50.0, 15.0, math.inf, math.inf]]
    assert lead.closing_speed.tolist() == [[5.0, 3.0, 0.0, 0.0]]
    nearest = estimate_leads(others, tensor(15.0), NO_ERRORS, HumanDriverModel(leaders=1))
    assert nearest.gap.tolist() == [[math.inf, 15.0, math.inf, math.inf]]


def test_one_leader_is_answered_as_by_the_idm() -> None:
    lead = Lead(tensor(20.0, math.inf, 3.0), tensor(4.0, 0.0, 9.0))
    expected = MODEL.idm.acceleration(tensor(15.0, 10.0, 15.0), lead)
    alone = Lead(*(each[:, None] for each in lead))
    assert respond(alone, tensor(15.0, 10.0, 15.0), MODEL).tolist() == expected.tolist()
    assert expected[2].item() == pytest.approx(-0.774 * 9.80665)


@pytest.mark.parametrize("leaders", [1, 2, 5])
def test_a_queue_in_equilibrium_keeps_the_gap_of_the_idm(leaders: int) -> None:
    """Equal speeds and gaps s: sum_j (s* / (j s))^2 / sum_j j^-2 = (s* / s)^2, so a = 0 where IDM's is."""
    speed, v0 = 15.0, 120 / 3.6
    gap = (2.0 + 1.0 * speed) / math.sqrt(1 - (speed / v0) ** 4)
    queue = percept(*((j * (gap + 5.0), speed, True) for j in range(1, leaders + 1)))
    lead = estimate_leads(queue, tensor(speed), NO_ERRORS, MODEL)
    assert respond(lead, tensor(speed), MODEL).item() == pytest.approx(0.0, abs=1e-12)


def test_the_cut_off_keeps_a_driver_from_braking_for_a_lead_that_pulls_away() -> None:
    away = Lead(tensor(10.0), tensor(-20.0))
    assert MODEL.idm.acceleration(tensor(20.0), away).item() == pytest.approx(1 - (20 * 3.6 / 120) ** 4 - 0.2**2)
    assert IDM().acceleration(tensor(20.0), away).item() == -5.0


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
