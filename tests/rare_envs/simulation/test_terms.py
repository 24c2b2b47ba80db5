"""Terms of rollouts: their least is f to the bit, in every scenario, for every measure that is a least over moments."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
from agents import load_ego
from rare_envs.measures import MEASURES, Measure, MeasureTerms
from rare_envs.simulation.rollout import drive

SHORT = 5.0
"""Seconds of rollouts that are compared tick by tick: half of the usual ones."""
CASES: dict[str, tuple[str, dict[str, Any], int]] = {
    "car-following": ("rare_envs/CarFollowing-v0", {"base": "highway"}, 300),
    "cut-in": ("rare_envs/CutIn-v0", {"base": "highway"}, 300),
    "hard brake": ("rare_envs/HardBrake-v0", {}, 300),
    "highway": ("rare_envs/Highway-v0", {}, 64),
    "highway, imitation": ("rare_envs/Highway-v0", {"ego": "imitation", "noise": "fixed"}, 64),
    "highway, any": ("rare_envs/Highway-v0", {"collisions": "any"}, 64),
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


def cases() -> Iterator[Any]:
    for case in CASES:
        measures = ("clearance", "lidar_ttc") if case.startswith("highway") else MEASURES
        yield from (pytest.param(case, measure, id=f"{case}-{measure}") for measure in measures)


@pytest.mark.parametrize(("case", "measure"), list(cases()))
def test_the_least_term_is_f_and_decides_the_failure(case: str, measure: str) -> None:
    problem, x = make(case, measure=measure, horizon=SHORT)
    x = x[:20] if measure == "pet" else x  # slow
    f = problem.evaluate(x)
    for gamma in (0.0, 0.7):
        terms = problem.terms(x, gamma)
        assert np.array_equal(terms.f, f)
        assert terms.values.shape == terms.ticks.shape == (len(x), len(terms.names))
        if (terms.threshold, len(terms.names)) == (gamma, 1) or gamma != 0.0:
            assert np.array_equal(terms.lowest, f)
        assert np.array_equal(terms.lowest <= terms.threshold, f <= gamma)
        assert ((terms.ticks >= 0) & (terms.ticks <= problem.world.clock.ticks)).all()


@pytest.mark.parametrize("case", ["cut-in", "highway"])
def test_ticks_are_those_of_the_recorded_episode(case: str) -> None:
    problem, x = make(case, measure="clearance")
    x = x[:30]
    terms, measure = problem.terms(x, 0.7), MEASURES["clearance"]
    assert isinstance(measure, Measure)
    with torch.inference_mode():
        episodes = list(drive(problem.world, problem.driver, torch.from_numpy(x).float()))
    for row in np.flatnonzero(terms.f > 0):
        distances = []
        for episode in episodes:
            before = rare_envs.measures.Moment(episode.state, episode.lead, episode.road, None)
            distances.append(measure.term_values(before)[row].numpy())
        for part, first in ((slice(0, 46), 0), (slice(46, None), 46)):  # the cut is at tick 45 of 100
            of_part = np.array(distances)[part]
            count = of_part.shape[1]
            columns = slice(0, count) if first == 0 else slice(count, None)
            np.testing.assert_array_equal(terms.ticks[row, columns], of_part.argmin(0) + first)
            np.testing.assert_allclose(terms.values[row, columns], of_part.min(0), rtol=1e-5)


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
