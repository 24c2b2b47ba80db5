"""Which worlds of learned drivers have compiled rollouts."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import agents
import rare_envs
from agents.learned.lane_changes import LaneChanges
from agents.names import SHIPPED_DRIVERS
from rare_envs.control import IDM
from rare_envs.scenarios import highway
from rare_envs.simulation import World
from rare_envs.simulation.compiled.failures import NotCompiled
from rare_envs.simulation.compiled.highway import find_highway_rollout

HIGHWAY = "rare_envs/Highway-v0"


@pytest.mark.parametrize("collisions", ["ego", "any"])
@pytest.mark.parametrize("measure", ["ttc", "lidar_ttc", "clearance"])
def test_measures_and_collisions_that_are_compiled(measure, collisions):
    problem = rare_envs.DrivingProblem(HIGHWAY, measure=measure, collisions=collisions)
    assert problem.core == "numba" and problem.terms_with_f


@pytest.mark.parametrize("name", SHIPPED_DRIVERS)
def test_shipped_drivers_are_compiled(name):
    assert rare_envs.DrivingProblem(HIGHWAY, drivers=name).core == "numba"
    assert rare_envs.DrivingProblem(HIGHWAY, ego=agents.load_ego(name)).core == "numba"


def test_a_file_of_ones_own_with_lane_changes_is_compiled(tmp_path):
    driver = replace(agents.load_driver("mgail5"), changes=LaneChanges(duration=5.0), hard_braking=0.9)
    provenance = agents.read_provenance(Path(agents.__file__).with_name("data") / "mgail5.safetensors")
    path = agents.save_driver(driver, provenance, tmp_path / "mine.safetensors")
    compiled, reference = (
        rare_envs.DrivingProblem(HIGHWAY, drivers=str(path), horizon=3.0, core=core) for core in ("auto", "torch")
    )
    x = compiled.base.sample(20, np.random.default_rng(0))
    assert compiled.core == "numba" and np.abs(compiled.evaluate(x) - reference.evaluate(x)).max() < 1e-4


def test_lane_changes_of_another_class_are_simulated_by_torch():
    class Others(LaneChanges):
        """Begin at will."""

    driver = replace(agents.load_driver("mgail5"), changes=Others())
    assert rare_envs.DrivingProblem(HIGHWAY, drivers=driver).core == "torch"
    with pytest.raises(ValueError, match="a LearnedDriver with a network or methods of its own is not compiled"):
        rare_envs.DrivingProblem(HIGHWAY, drivers=driver, core="numba")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        ({"measure": "thw"}, "the measure 'thw' is not compiled"),
        ({"drivers": "idm"}, "the drivers, a .*, are not compiled"),
        ({"observation": "camera", "weather": True}, "parameters of the weather are not compiled"),
        ({"ego": "noisy:idm"}, "is not compiled"),
    ],
)
def test_what_is_not_compiled_is_simulated_by_torch(arguments, reason):
    arguments = {**arguments, "ego": agents.load_ego(arguments.get("ego", "idm"))}
    assert rare_envs.DrivingProblem(HIGHWAY, **arguments).core == "torch"
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: .*{reason}"):
        rare_envs.DrivingProblem(HIGHWAY, core="numba", **arguments)


def test_another_motion_of_the_drivers_is_not_compiled():
    scenario = replace(highway.HIGHWAY, driven=lambda state, action, dt: highway.driven(state, action, dt))
    with pytest.raises(NotCompiled, match="the scenario 'highway' with drivers is not compiled"):
        find_highway_rollout(World(scenario, background=agents.load_driver("mgail")), IDM())


@pytest.mark.parametrize("measure", ["ttc", "lidar_ttc", "clearance"])
def test_a_problem_is_sent_to_other_processes_with_its_core_and_measure(measure):
    problem = rare_envs.DrivingProblem(HIGHWAY, measure=measure, noise="fixed", horizon=2.0)
    x = problem.base.sample(3, np.random.default_rng(0))
    expected = problem.terms(x)
    sent = pickle.loads(pickle.dumps(problem))
    assert sent.core == "numba"
    assert np.array_equal(sent.evaluate(x), expected.f) and np.array_equal(sent.terms(x).values, expected.values)


def test_a_driver_that_is_changed_later_is_simulated_by_torch():
    driver = agents.load_driver("mgail")
    problem = rare_envs.DrivingProblem(HIGHWAY, drivers=driver, noise=False, horizon=1.0)
    x = problem.base.sample(2, np.random.default_rng(0))
    expected = problem.evaluate(x)
    handle = driver.policy.register_forward_hook(lambda *_: None)
    with pytest.warns(UserWarning, match="with a network or methods of its own is not compiled; torch simulates"):
        f = problem.evaluate(x)
    handle.remove()
    assert np.allclose(f, expected, atol=1e-4) and problem.core == "torch"


def test_no_rows():
    problem = rare_envs.DrivingProblem(HIGHWAY)
    assert problem.evaluate(np.empty((0, problem.dim))).shape == (0,)
    assert problem.terms(np.empty((0, problem.dim))).values.shape == (0, 10)
