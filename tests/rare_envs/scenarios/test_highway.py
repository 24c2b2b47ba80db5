"""Highway: its parameters, its drivers as part of x, and the agreement of environment and rollout."""

import numpy as np
import pytest
import torch
from scipy import stats

import agents
import rare_envs
from rare_envs.scenarios.highway import START_LANES
from rare_envs.simulation.world import drive
from rare_envs.traffic.road import i80

HIGHWAY = "rare_envs/Highway-v0"
SHORT = {"horizon": 2.0}


def draw(problem, n, seed=0):
    return problem.base.sample(n, np.random.default_rng(seed))


def test_parameters_are_the_papers_then_weights_and_noise():
    space = rare_envs.DrivingProblem(HIGHWAY).space
    assert rare_envs.DrivingProblem(HIGHWAY).column_names[:2] == ("s[0]", "s[1]")
    assert space.names == ("s", "t", "heading", "speed", "weights", "noise")
    assert space.sizes == (6, 6, 6, 6, 404, (2 + 100) * 5 * 2)
    x = space.columns(space.sample(4000, np.random.default_rng(0)))
    for name, low, width in (("s", 80, 40), ("t", -0.25, 0.5), ("heading", -3.6, 7.2), ("speed", 10, 10)):
        assert stats.kstest(((x[name] - low) / width).ravel(), stats.beta(2, 2).cdf).pvalue > 1e-3


def test_the_ego_starts_in_the_third_lane_and_everybody_has_one():
    problem = rare_envs.DrivingProblem(HIGHWAY, noise=False)
    state = problem.world.start(torch.from_numpy(draw(problem, 50))).state
    assert sorted(START_LANES) == list(range(6))
    lanes = i80().lane_of(state.y)
    assert (lanes == torch.tensor(START_LANES)).all()
    assert lanes[0, 0] == 2
    assert state.heading.abs().max() <= np.deg2rad(3.6)


def test_cross_entropy_finds_the_blocks():
    """24 Beta, 404 Normal in the box, and noise that stays: 428 and more dimensions."""
    from samplers.distributions import announced_blocks

    problem = rare_envs.DrivingProblem(HIGHWAY, measure="lidar_ttc", **SHORT)
    blocks = announced_blocks(problem)
    assert [block.dim for block in blocks.blocks] == [24, 404, problem.space.sizes[-1]]
    x = draw(problem, 200)
    weights = np.tile(np.arange(1, 201) / (200 * 201 / 2), (3, 1))
    moved = blocks.project(x, weights, 0.8)
    change = moved.blocks[1].gaussian.mean - blocks.blocks[1].gaussian.mean
    assert 0 < np.abs(change).max() <= 0.01 + 1e-12
    assert moved.blocks[2] is blocks.blocks[2]


def test_noise_and_weights_matter_and_nothing_else_is_random():
    problem = rare_envs.DrivingProblem(HIGHWAY, measure="lidar_ttc", **SHORT)
    x = draw(problem, 32)
    f = problem.evaluate(x)
    np.testing.assert_array_equal(problem.evaluate(x), f)
    for name in ("weights", "noise"):
        other = x.copy()
        at = problem.space._slices[problem.space.names.index(name)]
        other[:, at] = draw(problem, 32, seed=1)[:, at]
        assert np.mean(problem.evaluate(other) != f) > 0.5


@pytest.mark.parametrize("env_id", [env_id for env_id in rare_envs.ENV_IDS if env_id != HIGHWAY])
def test_learned_drivers_in_the_scripted_scenarios(env_id):
    problem = rare_envs.DrivingProblem(env_id, drivers="mgail", **SHORT)
    vehicles = problem.world.scenario.vehicles - 1
    own = problem.world.scenario.size
    assert problem.dim == own + 404 + 22 * vehicles * 2
    x = draw(problem, 64)
    f = problem.evaluate(x)
    assert np.isfinite(f).all()
    scripted = rare_envs.DrivingProblem(env_id, **SHORT)
    assert (scripted.evaluate(x[:, :own]) != f).any()
    last = list(drive(problem.world, problem.driver, torch.from_numpy(x).float()))[-1]
    assert last.state.y[:, 1:].abs().max() <= 5.0  # across, they stay on the scenario's path


@pytest.mark.parametrize(("drivers", "aside"), [("idm", 0.1), ("idm+mobil", 2.0)])
def test_drivers_by_rule_have_neither_weights_nor_noise(drivers, aside):
    for noise in (True, "fixed", False):
        problem = rare_envs.DrivingProblem(HIGHWAY, drivers=drivers, noise=noise, horizon=5.0)
        assert problem.dim == 24 and problem.world.uses_lidar == (drivers == "idm")
    x = draw(problem, 64)
    last = list(drive(problem.world, problem.driver, torch.from_numpy(x)))[-1]
    road = problem.world.scenario.road
    if drivers == "idm":  # they keep the lanes that they started in, on the curve too
        torch.testing.assert_close(road.lane_of(last.state.y), torch.tensor(START_LANES).expand(64, -1))
    assert (last.state.y - road.centre_of(last.state.y))[:, 1:].abs().max() < aside
    assert not road.off_road(last.state.y).any()


def test_a_learned_ego_looks_and_a_driver_is_no_ego():
    ego = agents.LearnedEgo(agents.load_driver("mgail"))
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v0", ego=ego, **SHORT)
    assert problem.world.uses_lidar
    assert np.isfinite(problem.evaluate(draw(problem, 16))).all()
    with pytest.raises(ValueError, match=r"agents\.LearnedEgo"):
        rare_envs.DrivingProblem(HIGHWAY, ego=agents.load_driver("mgail"))


def test_lidar_ttc_ends_before_the_collision():
    def f(measure):
        asleep = lambda observation: np.zeros((len(observation), 2))  # noqa: E731
        problem = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=measure, ego=asleep)
        return problem.evaluate(np.array([[30.0, 10.0, 20.0]]))[0]

    assert 0.0 < f("lidar_ttc") < 0.3
    assert f("ttc") == -1.0
