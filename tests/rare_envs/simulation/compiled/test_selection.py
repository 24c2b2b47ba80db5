"""Which worlds are compiled; what is not falls back to torch, or is refused with the reason."""

import importlib.util
import pickle
import sys
import warnings
from dataclasses import dataclass, replace

import numba
import numpy as np
import pytest

import agents
import rare_envs
from rare_envs.control import IDM
from rare_envs.scenarios import car_following
from rare_envs.simulation import World
from rare_envs.simulation.compiled import selection
from rare_envs.simulation.measurement import Measurement

CAR_FOLLOWING = "rare_envs/CarFollowing-v0"
X = np.array([[20.0, 15.0, 30.0]])


@pytest.mark.parametrize(
    ("env_id", "arguments", "reason"),
    [
        (CAR_FOLLOWING, {"measure": "thw"}, "measure 'thw'"),
        (CAR_FOLLOWING, {"ego": "human"}, "HumanDriver"),
        (CAR_FOLLOWING, {"drivers": "mgail"}, "worlds with drivers"),
        ("rare_envs/CutIn-v0", {"collisions": "any"}, "collisions of other vehicles"),
        (CAR_FOLLOWING, {"ego": "imitation"}, "a LearnedEgo, is not compiled"),
        ("rare_envs/Highway-v0", {}, "worlds with drivers are not compiled"),
    ],
)
def test_what_is_not_compiled_is_simulated_by_torch(env_id, arguments, reason):
    arguments = {**arguments, "ego": agents.load_ego(arguments.get("ego", "idm"))}
    assert rare_envs.DrivingProblem(env_id, **arguments).core == "torch"
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: .*{reason}"):
        rare_envs.DrivingProblem(env_id, core="numba", **arguments)


def test_a_core_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match="Expected core to be one of 'auto', 'torch', 'numba', got 'jax'"):
        rare_envs.DrivingProblem(CAR_FOLLOWING, core="jax")


def test_an_own_measure_of_the_same_name_is_not_compiled():
    measure = rare_envs.measures.Measure(rare_envs.measures.ttc)
    assert rare_envs.DrivingProblem(CAR_FOLLOWING, measure=measure).core == "torch"


def test_another_world_or_driver_is_what_is_simulated():
    x = np.array([[20.0, 15.0, 30.0]])
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING)
    problem.driver = IDM(max_deceleration=0.1)
    assert (problem.core, problem.evaluate(x)) == ("numba", [-1.0])
    problem.world = replace(problem.world, measurement=Measurement("thw"))
    problem.driver = IDM()
    expected = rare_envs.DrivingProblem(CAR_FOLLOWING, measure="thw", core="torch").evaluate(x)
    assert (problem.core, problem.evaluate(x)) == ("torch", expected)


def test_without_numba_torch_simulates(monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numba" else find(name))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        problem = rare_envs.DrivingProblem(CAR_FOLLOWING)
    assert problem.core == "torch"
    with pytest.raises(ValueError, match=r"numba is not installed: pip install 'rare-envs\[driving\]'"):
        rare_envs.DrivingProblem(CAR_FOLLOWING, core="numba")


def test_where_numba_fails_torch_simulates_and_one_line_says_so(monkeypatch):
    def fail(*_):
        raise ImportError("Numba needs NumPy 2.5 or less")

    numeric = tuple(f"{selection.__package__}.{name}" for name in ("r", "scripted_rollouts"))
    for name in [name for name in sys.modules if name.startswith(numeric)]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(sys.modules[selection.__package__], "scripted_rollouts", raising=False)
    monkeypatch.setattr("rare_envs.compilation.single", fail)
    with pytest.warns(UserWarning, match=r"fails here: .*NumPy 2\.5 or less; torch simulates, which is slower\.$"):
        problem = rare_envs.DrivingProblem(CAR_FOLLOWING)
    assert problem.core == "torch"
    assert problem.evaluate(np.array([[20.0, 15.0, 30.0]])) == pytest.approx(6.0)


@pytest.mark.parametrize("ask", [lambda problem: problem.core, lambda problem: problem.evaluate(X)])
def test_where_the_first_call_cannot_be_compiled_torch_simulates_and_one_line_says_so(monkeypatch, ask):
    def fail(*_):
        raise numba.core.errors.TypingError("No implementation of\nfunction")

    monkeypatch.setattr("rare_envs.simulation.compiled.scripted_rollouts.drive_by_idm", fail)
    problem, strict = (rare_envs.DrivingProblem(CAR_FOLLOWING, core=core) for core in ("auto", "numba"))
    line = "numba is installed, but fails here: TypingError: No implementation of function"
    with pytest.warns(UserWarning, match=f"^{line}; torch simulates, which is slower\\.$"):
        ask(problem)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert problem.core == "torch"
        assert problem.evaluate(X) == pytest.approx(6.0)
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: {line}"):
        ask(strict)


def test_a_problem_is_sent_to_other_processes_with_its_core():
    problem = pickle.loads(pickle.dumps(rare_envs.DrivingProblem(CAR_FOLLOWING)))
    assert problem.core == "numba"
    assert problem.evaluate(np.array([[20.0, 15.0, 30.0]])) == pytest.approx(6.0)


def test_worlds_and_drivers_that_were_sent_stay_compiled():
    sent = pickle.loads(pickle.dumps(rare_envs.DrivingProblem(CAR_FOLLOWING)))
    fresh = rare_envs.DrivingProblem(CAR_FOLLOWING, core="numba")
    fresh.world, fresh.driver = sent.world, sent.driver
    assert (fresh.core, fresh.evaluate(X)) == ("numba", pytest.approx(6.0))


def test_a_process_without_numba_says_what_it_lacks(monkeypatch):
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING, core="numba")
    monkeypatch.delattr(sys.modules[selection.__package__], "scripted_rollouts")
    monkeypatch.setitem(sys.modules, f"{selection.__package__}.scripted_rollouts", None)
    with pytest.raises(ValueError, match=r"install 'rare-envs\[driving\]' wherever it is simulated"):
        problem.evaluate(np.array([[20.0, 15.0, 30.0]]))


def test_a_scenario_of_callable_objects_without_a_hash_is_simulated_by_torch():
    @dataclass
    class Place:
        shift: float = 0.0

        def __call__(self, x):
            return car_following.initial(x + self.shift)

    world = World(replace(car_following.CAR_FOLLOWING, initial=Place()))
    with pytest.raises(selection.NotCompiled, match="script of the scenario 'car_following' is not compiled"):
        selection.find_compiled_rollout(world, IDM())
