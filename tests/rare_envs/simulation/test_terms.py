"""Terms of rollouts: their least is f to the bit, in every scenario, for every measure that is a least over moments."""

from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
from agents import load_ego
from rare_envs.control.idm import IDM
from rare_envs.measures import MEASURES, Measure, MeasureTerms
from rare_envs.measures.registry import find_order
from rare_envs.simulation import terms as term_gradients
from rare_envs.simulation.terms import ROLLOUTS_PER_GRADIENT, differentiate_terms
from rare_envs.simulation.world import drive

SHORT = 3.0
"""Seconds of rollouts, of the usual 10."""
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "car-following": ("rare_envs/CarFollowing-v0", {"base": "highway"}, 150),
    "cut-in": ("rare_envs/CutIn-v0", {"base": "highway"}, 150),
    "cut-in of people": ("rare_envs/CutIn-v1", {}, 150),
    "hard brake": ("rare_envs/HardBrake-v0", {}, 150),
    "highway": ("rare_envs/Highway-v0", {}, 24),
    "highway, imitation": ("rare_envs/Highway-v0", {"ego": "imitation", "noise": "fixed"}, 24),
    "highway, any": ("rare_envs/Highway-v0", {"collisions": "any"}, 24),
}


def make(case: str, **more: Any) -> tuple[rare_envs.DrivingProblem, np.ndarray]:
    """Return a problem and draws, further apart than those of the base so that many collide."""
    env_id, options, count = CASES[case]
    options = {**options, **more}
    if options.get("ego") == "imitation":
        options["ego"] = load_ego("imitation")
    problem = rare_envs.DrivingProblem(env_id, core="torch", **options)  # terms are of the reference
    spread = 4.0 if case.startswith("highway") else 2.0
    u = spread * np.random.default_rng(5).standard_normal((count, problem.dim))
    return problem, problem.base.from_standard_normal(u)


@pytest.mark.parametrize(
    ("case", "measure"),
    [
        (case, measure)
        for case in CASES
        for measure in (("clearance", "lidar_ttc") if case.startswith("highway") else MEASURES)
    ],
)
def test_the_least_term_is_f_and_decides_the_failure(case: str, measure: str) -> None:
    problem, x = make(case, measure=measure, horizon=SHORT)
    x = x[:8] if measure == "pet" else x  # slow
    f = problem.evaluate(x)
    for gamma in (0.0, 0.7):
        terms = problem.terms(x, gamma)
        assert np.array_equal(terms.f, f)
        assert terms.values.shape == terms.ticks.shape == (len(x), len(terms.names))
        if (terms.threshold, len(terms.names)) == (gamma, 1) or gamma != 0.0:
            assert np.array_equal(terms.lowest, f)
        assert np.array_equal(terms.lowest <= terms.threshold, f <= gamma)
        assert ((terms.ticks >= 0) & (terms.ticks <= problem.world.clock.ticks)).all()


def test_a_measure_of_ones_own_with_terms() -> None:
    def distances(moment: Any) -> torch.Tensor:
        return (moment.state.x[:, 1:] - moment.state.x[:, :1]).abs()

    measure = Measure(lambda moment: distances(moment).amin(1), terms=MeasureTerms(distances), unit="m")
    problem, x = make("cut-in", measure=measure)
    terms = problem.terms(x, 8.0)
    assert terms.names == ("cutter", "lead")
    assert np.array_equal(terms.lowest, problem.evaluate(x))
    assert set(terms.least) == {0, 1} or (terms.least == 0).all()
    assert problem.gradient is not None


FOLLOWING, CUT_IN, HIGHWAY = "rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0", "rare_envs/Highway-v0"


class Coasting:
    """A driver that keeps its speed."""

    def act(self, episode: Any, memory: Any) -> tuple[torch.Tensor, Any]:
        return torch.zeros_like(episode.state.x[:, :2]), memory


class Policy:
    """A black box: brakes the harder, the nearer the lead is."""

    def predict(self, observation: np.ndarray, **_: object) -> tuple[np.ndarray, None]:
        brake = -np.clip(1.0 - observation[:, 3], 0.0, 1.0)
        return np.stack((brake, 0.0 * brake), 1).astype(np.float32), None


def gradients(problem: rare_envs.DrivingProblem, x: Any, gamma: float = 0.0) -> term_gradients.EpisodeGradients:
    """Differentiate the least term of each scenario."""
    x = np.asarray(x, dtype=np.float64)
    terms = problem.terms(x, gamma)
    assert problem.gradient is not None
    return problem.gradient(x, terms.least, terms.ticks[np.arange(len(x)), terms.least], gamma)


def test_distance_to_a_lead_by_pencil_and_paper() -> None:
    """After t seconds the gap is gap - (ego_speed - lead_speed) t; a collision is differentiated a tick before it."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=Coasting())
    x = [[20.0, 18.0, 100.0], [20.0, 30.0, 40.0], [30.0, 20.0, 20.25]]
    found = gradients(problem, x)
    times = [10.0, 0.0, 2.0]  # at the end; at the start; contact between 2.0 and 2.1 s
    np.testing.assert_allclose(found.values, [[-t, t, 1.0] for t in times], atol=1e-4)
    assert found.through_ego


def test_time_to_collision_by_pencil_and_paper() -> None:
    """Gap over closing speed, least after 10 s, where the gap is gap - 10 closing."""
    problem = rare_envs.DrivingProblem(FOLLOWING, ego=Coasting())
    found = gradients(problem, [[22.0, 18.0, 60.0]], gamma=6.0)  # 60 / 4 - 10 = 5 s
    np.testing.assert_allclose(found.values, [[-60.0 / 16.0, 60.0 / 16.0, 1.0 / 4.0]], rtol=1e-4)


def test_central_differences_in_double_precision() -> None:
    problem = rare_envs.DrivingProblem(CUT_IN, measure="clearance")
    x = problem.base.sample(60, np.random.default_rng(3))
    terms = problem.terms(x)
    rows, least = np.arange(len(x)), terms.least
    ticks = terms.ticks[rows, least]
    order, _ = find_order(MEASURES["clearance"], "ego", 0.0)
    assert order is not None
    by_autograd = differentiate_terms(problem.world, IDM(), order, x, least, ticks, dtype=torch.float64).values

    steps = 1e-5 * x.std(axis=0)
    shifts = np.concatenate([np.diag(steps), -np.diag(steps)])[:, None]
    points = (x + shifts).reshape(-1, x.shape[1])
    moved = np.empty((len(shifts), len(x)))
    for tick, episode in enumerate(drive(problem.world, IDM(), torch.from_numpy(points))):
        moment = rare_envs.measures.Moment(episode.state, episode.lead, episode.road, None)
        here = order.term_values(moment).detach().numpy().reshape(len(shifts), len(x), -1)
        moved = np.where(ticks == tick, here[:, rows, least % here.shape[2]], moved)
    ahead, behind = np.split(moved, 2)
    alive = problem.evaluate(x) > 0.0
    for j, step in enumerate(steps):
        by_differences = (ahead[j] - behind[j]) / (2.0 * step)
        wrong = np.abs(by_autograd[:, j] - by_differences) > 1e-5 * (1.0 + np.abs(by_differences))
        assert wrong[alive].mean() <= 0.05, j  # a clamp or a root within a step of its kink


@pytest.mark.slow
@pytest.mark.parametrize("measure", ["clearance", "lidar_ttc"])
def test_central_differences_among_learned_drivers(measure: str) -> None:
    """Along the gradient, in single precision: f is rough at this scale in half of the rows, by beams and ticks."""
    problem = rare_envs.DrivingProblem(HIGHWAY, measure=measure, noise="fixed")
    x = problem.base.sample(24, np.random.default_rng(4))
    terms = problem.terms(x)
    rows, least = np.arange(len(x)), terms.least
    found = gradients(problem, x)
    scale = problem.base.sample(500, np.random.default_rng(0)).std(axis=0)
    slope = found.values * scale
    norm = np.linalg.norm(slope, axis=1)
    step = np.clip(3e-3 * slope / norm[:, None] * scale, problem.space.low - x, problem.space.high - x)
    there = [problem.terms(x + sign * step).values[rows, least] for sign in (1.0, -1.0)]
    ratio = (there[0] - there[1]) / 2.0 / (found.values * step).sum(axis=1)
    assert np.isfinite(found.values).all()
    assert (np.abs(ratio - 1.0) < 1e-3).mean() >= 0.3
    assert (ratio > 0.0).mean() >= 0.75


def test_a_black_box_is_taken_as_given_and_said_so() -> None:
    x = [[25.0, 15.0, 40.0], [20.0, 18.0, 30.0]]
    policy, coasting = (rare_envs.DrivingProblem(FOLLOWING, ego=ego) for ego in (Policy(), Coasting()))
    found = gradients(policy, x)
    assert not found.through_ego
    terms = policy.terms(np.array(x))
    times = 0.1 * terms.ticks[np.arange(2), terms.least]
    np.testing.assert_allclose(found.values, [[-t, t, 1.0] for t in times], atol=1e-3)
    assert gradients(coasting, x).through_ego

    class Numpy:
        """A driver that leaves torch."""

        def act(self, episode: Any, memory: Any) -> tuple[torch.Tensor, Any]:
            speed = episode.state.speed[:, :1].numpy()  # an error where there is a gradient
            return torch.from_numpy(np.concatenate((0.0 * speed, 0.0 * speed), 1)), memory

    found = gradients(rare_envs.DrivingProblem(FOLLOWING, ego=Numpy()), [[20.0, 18.0, 100.0]])
    assert not found.through_ego
    np.testing.assert_allclose(found.values, [[-10.0, 10.0, 1.0]], atol=1e-4)


def test_order_of_rows_and_tiles_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = rare_envs.DrivingProblem(CUT_IN)
    x = problem.base.sample(12, np.random.default_rng(6))
    whole = gradients(problem, x)
    order = np.random.default_rng(7).permutation(len(x))
    np.testing.assert_allclose(gradients(problem, x[order]).values, whole.values[order], rtol=1e-4, atol=1e-5)
    monkeypatch.setattr(term_gradients, "GRADIENT_TILE", 5)
    tiled = gradients(problem, x)
    np.testing.assert_allclose(tiled.values, whole.values, rtol=1e-4, atol=1e-5)
    monkeypatch.setattr(term_gradients, "KEPT_SHARE", -1.0)  # nobody is left out
    together = gradients(problem, x)
    np.testing.assert_allclose(together.values, whole.values, rtol=1e-4, atol=1e-5)
    assert together.cost > tiled.cost


def test_cost_goes_by_the_moments_simulated() -> None:
    problem = rare_envs.DrivingProblem(FOLLOWING)
    x = problem.base.sample(10, np.random.default_rng(8))
    assert problem.gradient is not None

    def cost(*ticks: int) -> float:
        assert problem.gradient is not None
        return problem.gradient(x, np.zeros(10, dtype=np.int64), np.repeat(ticks, 10 // len(ticks))).cost

    assert cost(100) == pytest.approx(10 * ROLLOUTS_PER_GRADIENT)
    assert cost(0) == pytest.approx(10 * ROLLOUTS_PER_GRADIENT / 101)
    assert cost(0, 100) == pytest.approx(5 * ROLLOUTS_PER_GRADIENT * 102 / 101)
    assert problem.gradient_cost == ROLLOUTS_PER_GRADIENT


@pytest.mark.parametrize(
    "measure", ["tet", "pet", lambda moment: torch.from_numpy(moment.state.x.detach().numpy()[:, 0])]
)
def test_a_measure_without_a_gradient_offers_none(measure: Any) -> None:
    assert rare_envs.DrivingProblem(FOLLOWING, measure=measure).gradient is None
