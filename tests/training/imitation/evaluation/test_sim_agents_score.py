"""The realism score by pencil and paper."""

import math

import pytest
import torch

from training.imitation.evaluation.sim_agents_features import FEATURE_NAMES
from training.imitation.evaluation.sim_agents_score import (
    BUCKETS,
    MOTORWAY,
    SCENE_ROLLOUTS,
    WOSAC_2023,
    WOSAC_2024,
    FeatureSetting,
    feature_likelihood,
    histogram_log_likelihood,
    score_rollouts,
)

HALVES = FeatureSetting(0.0, 2.0, 2, 1.0, pseudocount=0.5)
T, EDGES = 41, (-1.75, 5.25)


def record():
    """Three vehicles (3, T, 3): one speeds up, one follows another that is faster than it; none turns."""
    clock = 0.1 * torch.arange(T)
    x = torch.stack((12 * clock + 0.4 * clock**2, 14 * clock, 25 + 16 * clock))
    y = torch.tensor([0.0, 3.5, 3.5])[:, None].expand(-1, T)
    return torch.stack((x, y, torch.zeros_like(x)), dim=-1)


VALID, SIZES = torch.ones(3, T, dtype=torch.bool), torch.tensor([[4.5, 1.9]] * 3)


def score(rollouts, valid=VALID, recorded=None, **kwargs):
    recorded = record() if recorded is None else recorded
    return score_rollouts(rollouts, recorded, valid, SIZES, EDGES, **kwargs)["wosac_2024"]


def copies(states):
    return states.expand(SCENE_ROLLOUTS, -1, -1, -1)


def test_a_histogram_of_two_bins():
    """Agent 0: 3 of 4 values in the first bin, (3 + .5) / (4 + 1); agent 1: none of 4, and one beyond the last edge."""
    simulated = torch.tensor([[[0.1, 0.9], [1.1, 9.0]], [[0.2, 1.5], [1.9, 1.0]]])
    recorded = torch.tensor([[0.5, 1.5], [-3.0, 1.2]])
    found = histogram_log_likelihood(simulated, recorded, torch.ones(2, 2, dtype=torch.bool), HALVES).exp()
    torch.testing.assert_close(found, torch.tensor([[3.5 / 5, 1.5 / 5], [0.5 / 5, 4.5 / 5]], dtype=torch.float64))


def test_the_likelihood_is_the_geometric_mean_over_agents_and_steps():
    simulated = torch.tensor([[[0.1, 0.9], [1.1, 9.0]], [[0.2, 1.5], [1.9, 1.0]]])
    recorded, valid = torch.tensor([[0.5, 1.5], [0.5, 1.2]]), torch.ones(2, 2, dtype=torch.bool)
    expected = (0.7 * 0.3 * 0.1 * 0.9) ** 0.25
    assert feature_likelihood("linear_speed", simulated, recorded, valid, HALVES) == pytest.approx(expected)


def test_invalid_and_missing_steps_count_neither_in_the_histogram_nor_in_the_mean():
    simulated = torch.tensor([[[0.1, 0.9, 1.5]], [[0.2, math.nan, 1.5]]])
    recorded, valid = torch.tensor([[0.5, 1.5, 0.5]]), torch.tensor([[True, True, False]])
    # three values are left, all in the first bin
    expected = math.sqrt(3.5 / 4 * 0.5 / 4)
    assert feature_likelihood("linear_speed", simulated, recorded, valid, HALVES) == pytest.approx(expected)
    missing = torch.tensor([[0.5, math.nan, 0.5]])
    assert feature_likelihood("linear_speed", simulated, missing, valid, HALVES) == pytest.approx(2.5 / 3)


def test_an_event_counts_once_in_a_rollout():
    """Of four rollouts one collides, at two steps; agent 0 of the record collides, agent 1 does not."""
    simulated = torch.zeros(4, 2, 5)
    simulated[0, :, 2:4] = 1.0
    recorded = torch.zeros(2, 5)
    recorded[0, 1] = 1.0
    valid = torch.ones(2, 5, dtype=torch.bool)
    setting = WOSAC_2024["collision_indication"]
    expected = math.sqrt(1.001 / 4.002 * 3.001 / 4.002)
    assert feature_likelihood("collision_indication", simulated, recorded, valid, setting) == pytest.approx(expected)
    valid[:, 2:] = False  # then no rollout collides while the record goes on
    expected = math.sqrt(0.001 / 4.002 * 4.001 / 4.002)
    assert feature_likelihood("collision_indication", simulated, recorded, valid, setting) == pytest.approx(expected)


@pytest.mark.parametrize(("settings", "total"), [(WOSAC_2024, 1.0), (MOTORWAY, 1.0), (WOSAC_2023, 0.99)])
def test_weights_sum_to_one_and_cover_every_feature(settings, total):
    assert tuple(settings) == FEATURE_NAMES
    assert sum(setting.weight for setting in settings.values()) == pytest.approx(total)
    assert sorted(name for members in BUCKETS.values() for name in members) == sorted(FEATURE_NAMES)


def test_copies_of_steady_motion_score_their_bound():
    """Every feature stays in one bin: its probability is (n + a) / (n + k a) with n values, k bins, pseudocount a."""
    clock = 0.1 * torch.arange(T)
    x = torch.stack((12 * clock, 30 + 12 * clock, 30 + 12 * clock))
    steady = torch.stack((x, torch.tensor([0.0, 0.0, 3.5])[:, None].expand(-1, T), torch.zeros_like(x)), dim=-1)
    found = score(copies(steady), recorded=steady)
    differences = {"linear_speed": 2, "angular_speed": 2, "time_to_collision": 2}
    differences |= {"linear_acceleration": 4, "angular_acceleration": 4}
    for name, likelihood in found.likelihoods.items():
        setting = WOSAC_2024[name]
        n = SCENE_ROLLOUTS * (1 if name.endswith("indication") else T - differences.get(name, 1))
        bound = (n + setting.pseudocount) / (n + setting.bins * setting.pseudocount)
        assert likelihood == pytest.approx(bound), name
    assert 0.999 < found.meta < 1.0
    assert found.min_ade == 0.0


def test_copies_score_better_than_anything_that_is_offset():
    perfect = score(copies(record()))
    assert perfect.likelihoods["collision_indication"] > 0.999
    for axis, size, worse in ((0, 6.0, "min_ade"), (1, -4.5, "offroad_indication")):
        moved = record()
        moved[:1, 1:, axis] += size  # of the first vehicle, from the first future step on
        found = score(copies(moved))
        assert found.meta < perfect.meta - 0.01
        if worse in found.likelihoods:
            assert found.likelihoods[worse] < perfect.likelihoods[worse]
    faster = record()
    faster[..., 0] *= 1.5
    assert score(copies(faster)).likelihoods["linear_speed"] < 0.5 * perfect.likelihoods["linear_speed"]


def test_what_happens_at_invalid_steps_does_not_matter():
    valid = VALID.clone()
    valid[:, 25:] = False
    astray = copies(record()).clone()
    astray[:, :, 25:] += 100.0 * torch.rand(SCENE_ROLLOUTS, 3, T - 25, 3, generator=torch.Generator().manual_seed(0))
    assert score(astray, valid).likelihoods == score(copies(record()), valid).likelihoods
    assert score(astray).meta < score(copies(record())).meta


def test_agents_that_are_not_scored_are_still_hit():
    crash = record()
    crash[2, 10:, 0] = crash[1, 10:, 0] + 1.0
    first_two = torch.tensor([True, True, False])
    found = score(copies(crash), scored=first_two)
    assert found.likelihoods["collision_indication"] < 0.05  # the second is hit in every rollout, never in the record
    only = score(copies(crash), scored=torch.tensor([True, False, False]))
    assert only.likelihoods["collision_indication"] > 0.999


def test_the_score_is_the_weighted_mean():
    found = score(
        copies(record()) + torch.randn(SCENE_ROLLOUTS, 3, T, 3, generator=torch.Generator().manual_seed(1)) * 0.05
    )
    weighted = sum(WOSAC_2024[name].weight * value for name, value in found.likelihoods.items())
    assert found.meta == pytest.approx(weighted)
    kinematic = sum(found.likelihoods[name] for name in BUCKETS["kinematic"]) / 4
    assert found.buckets["kinematic"] == pytest.approx(kinematic)


def test_wrong_shapes_and_records_that_are_too_short_are_refused():
    with pytest.raises(ValueError, match="Expected rollouts of shape"):
        score(copies(record())[:, :2])
    valid = torch.zeros_like(VALID)
    valid[:, :4] = True
    with pytest.raises(ValueError, match="take longer records"):
        score(copies(record()), valid)
