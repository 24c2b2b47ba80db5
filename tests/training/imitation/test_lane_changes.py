import math
from dataclasses import replace

import pytest
import torch

from agents import load_driver, read_driver, read_provenance
from agents.learned.lane_changes import LaneChanges
from tests.training.imitation.synthetic_scenes import CROSSING, crossing_recording
from training.imitation.lane_changes import (
    BEFORE,
    RATES,
    ChangeMoments,
    add_changes,
    collect_moments,
    fit_hazard,
    fit_logistic,
    write_changing_driver,
)


def test_the_moment_before_a_crossing_is_the_beginning_of_a_change():
    recording = crossing_recording()
    moments = collect_moments(recording, LaneChanges())
    assert int(moments.begins.sum()) == 1
    assert moments.begins[~moments.other].tolist() == [[False, True]]  # to the right
    speed = recording.speed[1, CROSSING - round(10 * BEFORE), 0] - 10.0
    assert float(moments.covariates[~moments.other][0, 1, -1]) == pytest.approx(float(speed))
    assert not bool(moments.open[:, 0].all()) and bool(moments.open.any())


def test_logistic_regression_finds_the_coefficients_of_drawn_outcomes():
    generator = torch.Generator().manual_seed(0)
    inputs = torch.cat((torch.ones(20_000, 1), torch.randn(20_000, 2, generator=generator)), dim=1).double()
    truth = torch.tensor([-1.0, 0.8, -0.5], dtype=torch.float64)
    outcome = (torch.rand(20_000, generator=generator) < torch.sigmoid(inputs @ truth)).double()
    torch.testing.assert_close(fit_logistic(inputs, outcome), truth, atol=0.1, rtol=0)
    slopes = [float(fit_logistic(inputs, outcome, penalty)[1]) for penalty in (0.0, 1e4)]
    assert slopes[1] < 0.5 * slopes[0]


@pytest.mark.parametrize("penalty", [0.0, 1.0, 50.0])
def test_the_penalised_likelihood_has_no_slope_at_the_coefficients(penalty):
    generator = torch.Generator().manual_seed(1)
    scales = torch.tensor([1.0, 1.0, 20.0, 0.1])
    inputs = torch.cat((torch.ones(500, 1), torch.randn(500, 3, generator=generator)), dim=1).double() * scales
    outcome = (torch.rand(500, generator=generator) < 0.1).double()
    found = fit_logistic(inputs, outcome, penalty)
    slope = inputs.T @ (outcome - torch.sigmoid(inputs @ found)) - penalty * found * torch.tensor([0.0, 1.0, 1.0, 1.0])
    assert float(slope.abs().max()) < 1e-6


def test_the_mean_hazard_is_that_of_complete_recordings():
    """Changes begin twice as often where the next lane is 1 m/s faster; half of the moments have either speed."""
    n = 4000
    covariates = torch.zeros(n, 2, 5)
    covariates[..., 0], covariates[:, 1, 1] = 1.0, 1.0
    covariates[::2, :, 2] = 1.0
    speeds = torch.tensor([speed for speed, _ in RATES])
    covariates[..., 4] = speeds.repeat_interleave(2).repeat(n // 4)[:, None] - 10.0
    begins = torch.zeros(n, 2, dtype=torch.bool)
    begins[::40], begins[1::80] = True, True
    moments = ChangeMoments(covariates, torch.ones(n, 2, dtype=torch.bool), begins, ~begins.any(dim=1))
    coefficients = torch.tensor(fit_hazard(moments))
    assert float(coefficients[2]) == pytest.approx(math.log(2.0), abs=0.15)
    hazard = (covariates @ coefficients).exp().sum(dim=1)[moments.other]
    fast = covariates[moments.other, 0, 4] > -1.0
    for rows, (_, rate) in ((fast, RATES[0]), (~fast, RATES[1])):
        assert 10.0 * float(hazard[rows].mean()) == pytest.approx(rate, rel=0.01)


def test_a_driver_gets_lane_changes_and_balanced_noise(tmp_path):
    recording = crossing_recording()
    coefficients = (-5.0, -1.0, 0.1, 0.0, -0.1)
    out = write_changing_driver("mgail2", coefficients, 0.2, 0.8, recording, tmp_path / "changing.safetensors")
    made, plain = read_driver(out), load_driver("mgail2")
    assert made.name == "changing"
    assert made.changes == LaneChanges(coefficients=coefficients)
    assert (made.hard_braking, made.avoidance) == (0.8, plain.avoidance)
    assert made.colour == add_changes(plain, coefficients, 0.2, 0.8, "any").colour
    assert made.colour.balanced
    provenance = read_provenance(out)
    assert provenance.kind == "mgail, rule of collision avoidance, lane changes"
    assert provenance.command.endswith("--driver mgail2 --damping 0.2 --out OUT")
    assert set(provenance.metrics) == {"10 s", "20 s"}


def test_the_shipped_driver_is_mgail2_with_lane_changes():
    shipped, plain = load_driver("mgail3"), load_driver("mgail2")
    assert replace(shipped.changes, coefficients=LaneChanges().coefficients) == LaneChanges()
    assert shipped.avoidance == plain.avoidance
    features = torch.zeros(1, 1, 51)
    same = replace(shipped, changes=None, hard_braking=1.0)
    assert torch.equal(same.act(features)[0], plain.act(features)[0])


def test_a_rule_alone_is_refused(tmp_path):
    with pytest.raises(ValueError, match="Expected a learned driver, got the rule 'idm'"):
        write_changing_driver("idm", (0.0,) * 5, 0.2, 0.7, None, tmp_path / "changing.safetensors")
