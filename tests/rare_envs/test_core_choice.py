"""CoreChoice: compiled rollouts where they can be had, torch for everything else, and what is said of it."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import pytest
import torch

import rare_envs
import samplers
from rare_envs import core_choice
from rare_envs.control import actions
from rare_envs.control.idm import IDM
from rare_envs.core_choice import CoreChoice, is_compiled_script
from rare_envs.egos.policy import as_driver, find_device_driver
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.highway import HIGHWAY
from rare_envs.simulation.compiled import selection
from rare_envs.simulation.compiled.failures import CompilerFails, NotCompiled
from rare_envs.simulation.measurement import Measurement
from rare_envs.simulation.world import World

WORLD, X = World(CAR_FOLLOWING), np.array([[20.0, 15.0, 30.0]])


def test_an_unknown_core_is_refused() -> None:
    with pytest.raises(ValueError, match="Expected core to be one of 'auto', 'torch', 'numba', got 'jax'"):
        CoreChoice("jax", WORLD, IDM())


def test_torch_is_never_compiled() -> None:
    choice = CoreChoice("torch", WORLD, IDM())
    assert choice.rollout is None
    assert choice.run(X) is None


def test_what_is_not_compiled_is_left_to_torch_in_silence_unless_numba_was_asked_for() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert CoreChoice("auto", World(HIGHWAY), IDM()).rollout is None
    with pytest.raises(ValueError, match="core='numba' cannot simulate this: the script of the scenario 'highway'"):
        CoreChoice("numba", World(HIGHWAY), IDM())
    with pytest.raises(ValueError, match="the ego, a float, is not compiled"):
        CoreChoice("numba", WORLD, 1.0)  # type: ignore[arg-type]


def test_a_compiler_that_fails_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(world: World, ego: object) -> None:
        raise CompilerFails("numba is installed, but fails here")

    monkeypatch.setattr(core_choice, "find_compiled_rollout", fail)
    with pytest.warns(UserWarning, match="fails here; torch simulates, which is slower"):
        assert CoreChoice("auto", WORLD, IDM()).run(X) is None


def test_a_rollout_that_has_become_impossible_is_given_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    def changed(x: np.ndarray) -> None:
        raise NotCompiled("the policy has changed")

    monkeypatch.setattr(core_choice, "find_compiled_rollout", lambda world, ego: changed)
    choice = CoreChoice("auto", WORLD, IDM())
    with pytest.warns(UserWarning, match="the policy has changed; torch simulates"):
        assert choice.run(X) is None
    assert choice.rollout is None
    with pytest.raises(ValueError, match="core='numba' cannot simulate this: the policy has changed"):
        CoreChoice("numba", WORLD, IDM()).run(X)


def test_compiled_rollouts_give_f() -> None:
    pytest.importorskip("numba", reason="compiled rollouts need numba, which the extra [fast] installs")
    found = CoreChoice("numba", WORLD, IDM()).run(X)
    assert found is not None
    assert found.tolist() == [6.0]
    assert found.dtype == np.float64


@pytest.mark.parametrize("env_id", ["rare_envs/CarFollowing-v0", "rare_envs/CutIn-v0"])
def test_both_cores_are_asked_the_same_and_give_the_same_estimate(env_id: str) -> None:
    """Rounding of f moves weights by a millionth; another sequence of points would move p by tenths."""
    pytest.importorskip("numba", reason="compiled rollouts need numba, which the extra [fast] installs")
    compiled, reference = (
        samplers.estimate(rare_envs.DrivingProblem(env_id, core=core), samplers.TwoStage(), seed=0, max_sim=1000)
        for core in ("numba", "torch")
    )
    assert compiled.p > 0
    assert compiled.p == pytest.approx(reference.p, rel=1e-5)
    assert compiled.failures.total == reference.failures.total


def test_scripts_are_compiled_ones_with_numba_or_without(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(selection, "_import_compiler", lambda: 1 / 0)
    assert is_compiled_script(WORLD, IDM())
    assert not is_compiled_script(World(HIGHWAY), IDM())
    assert not is_compiled_script(World(CAR_FOLLOWING, measurement=Measurement("clearance")), IDM())


class Fails(torch.nn.Module):
    """Goes straight on, but for the first row after some queries."""

    def __init__(self, answer: float, after: int) -> None:
        super().__init__()
        self.answer, self.left = answer, after

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        actions = torch.zeros(len(seen), 2)
        self.left -= 1
        if self.left < 0:
            if self.answer == 0.0:
                raise SystemExit(3)
            actions[0, 1] = self.answer
        return actions


def as_on_a_gpu(module: Any, measure: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what a choice for a GPU makes of two scenarios; the numbers stay here."""
    monkeypatch.setattr(actions, "can_look", lambda _: False)
    world = World(CAR_FOLLOWING, measurement=Measurement(measure))
    choice = CoreChoice("torch", world, as_driver(module, world), torch.device("cuda"), tile=64)
    with torch.inference_mode():
        return choice.roll_out(world, torch.tensor([[20.0, 25.0, 30.0], [20.0, 25.0, 40.0]]))


@pytest.mark.parametrize("answer", [0.0, math.nan, math.inf], ids=["error", "nan", "infinite"])
@pytest.mark.parametrize("measure", ["ttc", "lidar_ttc", "pet", "drac"])
@pytest.mark.parametrize("after", [0, 99])
def test_a_policy_that_fails_on_a_gpu_is_queried_again(
    answer: float, measure: str, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert as_on_a_gpu(Fails(answer, after), measure, monkeypatch) is None


def test_one_that_does_not_fail_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert as_on_a_gpu(Fails(math.nan, after=100), "lidar_ttc", monkeypatch).f.isfinite().all()


class Decides:
    """A policy of somebody's, who has another use for the word."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> Any:
        return np.zeros((len(observation), 2)), state

    def decide(self, observation: Any) -> Any:
        raise AssertionError("a method of this name says nothing of what it does")


def test_a_policy_of_anybody_is_queried_through_the_cpu() -> None:
    assert find_device_driver(as_driver(Decides(), WORLD), torch.device("cuda")) is None
