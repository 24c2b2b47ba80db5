"""What is compiled; what is not falls back to torch, or is refused with the reason."""

import warnings
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

import agents
import rare_envs
from rare_envs import IDM
from rare_envs.fast import rollouts
from rare_envs.scenarios import car_following
from rare_envs.scenarios.cut_in import CutterModel
from rare_envs.simulation.settings import Measurement
from rare_envs.traffic.state import State

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
def test_what_is_not_compiled_is_simulated_by_torch(env_id: str, arguments: dict[str, Any], reason: str) -> None:
    arguments = {**arguments, "ego": agents.load_ego(arguments.get("ego", "idm"))}
    problem = rare_envs.DrivingProblem(env_id, **arguments)
    assert problem.core == "torch"
    assert problem.terms_with_f
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: .*{reason}"):
        rare_envs.DrivingProblem(env_id, core="numba", **arguments)


def test_another_world_or_driver_is_what_is_simulated() -> None:
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING)
    assert (problem.core, problem.terms_with_f, problem.evaluate(X)) == ("numba", False, [6.0])
    problem.driver = IDM(max_deceleration=0.1)
    assert (problem.core, problem.evaluate(X)) == ("numba", [-1.0])
    problem.world = replace(problem.world, measurement=Measurement("thw"))
    expected = rare_envs.DrivingProblem(CAR_FOLLOWING, problem.driver, measure="thw", core="torch").evaluate(X)
    assert (problem.core, problem.evaluate(X)) == ("torch", expected)


def test_where_numba_fails_torch_simulates_and_one_line_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise RuntimeError("No implementation of\nfunction")

    monkeypatch.setattr(rollouts, "drive_by_idm", fail)
    line = "numba fails here: RuntimeError: No implementation of function"
    problem = rare_envs.DrivingProblem(CAR_FOLLOWING)
    with pytest.warns(UserWarning, match=f"^{line}; torch simulates, which is slower\\.$"):
        assert problem.evaluate(X) == pytest.approx(6.0)
    assert problem.core == "torch"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert (problem.core, problem.evaluate(X)) == ("torch", pytest.approx(6.0))
    with pytest.raises(ValueError, match=f"core='numba' cannot simulate this: {line}"):
        rare_envs.DrivingProblem(CAR_FOLLOWING, core="numba")


def test_a_scenario_that_places_the_vehicles_otherwise_is_compiled_and_a_script_of_ones_own_is_not() -> None:
    @dataclass
    class Place:  # without a hash
        shift: float

        def __call__(self, x: Any) -> Any:
            return car_following.initial(x + self.shift)

    compiled, own = (rare_envs.DrivingProblem(CAR_FOLLOWING) for _ in range(2))
    scenario = compiled.world.scenario
    compiled.world = replace(compiled.world, scenario=replace(scenario, initial=Place(1.0)))
    assert (compiled.core, compiled.evaluate(X)) == ("numba", pytest.approx(31.0 / 5.0))
    own.world = replace(own.world, scenario=replace(scenario, others=lambda state, dt: scenario.others(state, dt)))
    assert (own.core, own.evaluate(X)) == ("torch", pytest.approx(6.0))


def test_a_cutter_with_other_numbers_is_compiled_and_one_of_ones_own_class_is_not() -> None:
    class Bolder(CutterModel):
        """May decide otherwise."""

    compiled, reference = (rare_envs.DrivingProblem("rare_envs/CutIn-v1", core=core) for core in ("numba", "torch"))
    x = compiled.base.sample(300, np.random.default_rng(0))
    x[:, 3] -= 12.0  # beside the ego and close in front of it
    x = x[x[:, 3] > -10.0]
    usual = reference.evaluate(x)
    for problem in (compiled, reference):
        hasty = CutterModel(reaction_time=0.2, most_braking=0.5, coolness=0.5, margin=3.0).scenario()
        problem.world = replace(problem.world, scenario=hasty)
    assert (compiled.core, reference.core) == ("numba", "torch")
    expected = reference.evaluate(x)
    assert compiled.evaluate(x) == pytest.approx(expected, abs=1e-4) and (np.abs(expected - usual) > 0.1).any()
    own = rare_envs.DrivingProblem("rare_envs/CutIn-v1")
    own.world = replace(own.world, scenario=Bolder().scenario())
    assert own.core == "torch"


@pytest.mark.parametrize("env_id", [CAR_FOLLOWING, "rare_envs/HardBrake-v0"])
def test_a_script_with_more_vehicles_than_it_is_compiled_for_is_simulated_by_torch(env_id: str) -> None:
    def place(x: Any) -> State:
        *fields, theta = scenario.initial(x)
        fields = [torch.cat((field, field[:, 1:]), dim=1) for field in fields]
        fields[0][:, 1] += 50.0  # the nearer one comes last
        return State(*fields, theta)

    problem = rare_envs.DrivingProblem(env_id)
    scenario, x = problem.world.scenario, problem.base.sample(20, np.random.default_rng(0))
    expected = rare_envs.DrivingProblem(env_id, core="torch").evaluate(x)
    names = ("ego", "lead", "nearer lead")
    problem.world = replace(problem.world, scenario=replace(scenario, vehicle_names=names, labels=(), initial=place))
    assert problem.core == "torch"
    assert problem.evaluate(x) == pytest.approx(expected)


def test_the_lead_of_a_cut_in_that_begins_beside_its_line_is_on_it_after_a_tick_as_in_torch() -> None:
    def place(x: Any) -> State:
        state = scenario.initial(x)
        return state._replace(y=state.y + torch.tensor([0.0, 0.0, 3.8]), heading=state.heading + 0.3)

    compiled, reference = (rare_envs.DrivingProblem("rare_envs/CutIn-v0", core=core) for core in ("numba", "torch"))
    scenario, x = compiled.world.scenario, compiled.base.sample(100, np.random.default_rng(0))
    for problem in (compiled, reference):
        problem.world = replace(problem.world, scenario=replace(scenario, initial=place))
    assert (compiled.core, reference.core) == ("numba", "torch")
    assert compiled.evaluate(x) == pytest.approx(reference.evaluate(x), abs=1e-4)
