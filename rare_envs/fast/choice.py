"""Choice of what simulates: which worlds and egos are compiled, and the calls of what is. It needs no numba itself."""

from __future__ import annotations

import warnings
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import DISCRETE_ACTIONS
from rare_envs.control.idm import IDM
from rare_envs.egos.dense_policies import DensePolicy, NotCompiled, read_dense_policy
from rare_envs.egos.policy import PolicyDriver
from rare_envs.measures import MEASURES
from rare_envs.plugins import check_name, one_line
from rare_envs.scenarios import car_following, cut_in, hard_brake
from rare_envs.scenarios.cut_in import CUTTER, CutterModel
from rare_envs.simulation.observation import observation_space

if TYPE_CHECKING:
    from rare_envs.simulation.decision import StepResult
    from rare_envs.simulation.episode import Episode
    from rare_envs.simulation.world import Driver, World

CORES = ("auto", "torch", "numba")
"""Choices of what simulates."""
SCRIPTS = (
    (car_following.others, "STEADY", 2),
    (hard_brake.others, "BRAKING", 2),
    (cut_in.others, "CUT_IN", 3),
    (CutterModel.others, "HUMAN_CUT_IN", 3),
)
"""Motions of the other vehicles, names of their compiled twins in `rare_envs.fast.rows`, and how many vehicles these
are for, the ego included."""
MAX_UNITS = 128
"""Widest layer: beyond it torch's matrix products are faster than the compiled ones, which are made for few units."""


class CompilerFails(NotCompiled):
    """numba does not work here."""


def leave_to_torch(reason: NotCompiled, core: str, stacklevel: int) -> None:
    """Raise a ValueError if the core is to be "numba"; else warn if numba fails."""
    if core == "numba":
        raise ValueError(f"core='numba' cannot simulate this: {reason}.") from reason
    if isinstance(reason, CompilerFails):
        warnings.warn(f"{reason}; torch simulates, which is slower.", stacklevel=stacklevel + 1)


@cache
def import_compiler() -> Any:
    """Return the module that needs numba; raise CompilerFails where that is missing, switched off or fails."""
    try:
        from rare_envs.fast import rollouts
    except (ImportError, OSError, RuntimeError) as error:
        raise CompilerFails(f"numba fails here: {one_line(error)}") from error
    return rollouts


def is_compiled(world: World, driver: Driver) -> bool:
    """Return whether a world is a script that is compiled with this ego, whether numba works here or not."""
    try:
        find_script(world)
        read_ego(world, driver)
    except NotCompiled:
        return False
    return True


def simulate(world: World, driver: Driver, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return f of scenarios x (B, d), NaN if a policy's outputs are not finite; NotCompiled for others."""
    script, ego, compiled = find_script(world), read_ego(world, driver), import_compiler()
    with torch.inference_mode():
        state = world.scenario.initial(torch.from_numpy(x).float())
    try:
        numbers = compiled.numbers_of(*script, world.scenario.road, world.clock.dt)
        f: NDArray[np.float64] = compiled.drive(numbers, state, ego, world.clock.ticks)
    except Exception as error:  # numba compiles at the first call, where anything may be raised
        raise CompilerFails(f"numba fails here: {one_line(error)}") from error
    return f


def find_script(world: World, statistics: bool = False) -> tuple[str, CutterModel]:
    """Return the name of a world's compiled script, with statistics or not, and its cutter; else NotCompiled."""
    scenario, measurement = world.scenario, world.measurement
    cutter = getattr(scenario.others, "__self__", CUTTER)  # of a method; a class of a user's may decide otherwise
    script = getattr(scenario.others, "__func__", scenario.others) if type(cutter) is CutterModel else None
    known = [(name, vehicles) for others, name, vehicles in SCRIPTS if script is others]
    names = [name for name, vehicles in known if scenario.vehicles == vehicles]
    _refuse(
        {
            "worlds with drivers are": world.background is not None or bool(world.policies),
            f"the script of the scenario {scenario.name!r} is": not known,
            f"the script of {scenario.name!r} for {scenario.vehicles} vehicles is": not names,
            "curved roads and lanes of different widths are": scenario.road.reference_line is not None
            or not scenario.road.equal,
            f"the measure {measurement.measure!r} is": measurement.episode_measure != MEASURES["ttc"],
            "statistics of episodes are": measurement.statistics and not statistics,
            "collisions of other vehicles are": measurement.collisions != "ego",
            "limits of the ego's manoeuvres are": not world.rapid,
            "parameters of the weather are": world.dim != scenario.size,
        }
    )
    return names[0], cutter


def read_ego(world: World, driver: Driver) -> IDM | DensePolicy:
    """Return an ego as it is compiled, a policy with its present weights; raise NotCompiled if it is not."""
    if type(driver) is IDM:
        return driver
    if type(driver) is not PolicyDriver:
        raise NotCompiled(f"the ego, a {type(driver).__name__}, is not compiled")
    policy, sensing = read_dense_policy(driver.policy), world.sensing
    widths = [len(policy.layers[0][0][0]), *(len(bias) for _, bias in policy.layers)]
    _refuse(
        {
            f"the observation {sensing.observation!r} is": sensing.observation != "features",
            f"the action {world.clock.action!r} is": world.clock.action == "meta",
            f"a network of {widths[-1]} outputs is": widths[-1] != (len(DISCRETE_ACTIONS) if policy.chooses else 2),
            f"a network of {widths[0]} inputs is": (widths[0],) != observation_space(world.scenario.vehicles).shape,
            f"a network of {max(widths)} units in a layer, where torch is about as fast, is": max(widths) > MAX_UNITS,
        }
    )
    return policy


def _refuse(obstacles: dict[str, bool]) -> None:
    """Raise NotCompiled for the first of these that was found."""
    for words, found in obstacles.items():
        if found:
            raise NotCompiled(f"{words} not compiled")


class ScriptedStep:
    """Compiled steps of a world: an episode and actions to the episode a tick later, its reward and its features."""

    def __init__(self, world: World) -> None:
        """Take the numbers of a world, or raise NotCompiled."""
        script, sensing = find_script(world, statistics=True), world.sensing
        _refuse({f"the observation {sensing.observation!r} is": world.uses_lidar or "camera" in sensing.kinds})
        self._numbers = import_compiler().numbers_of(*script, world.scenario.road, world.clock.dt)

    def advance(self, episode: Episode, physical: Tensor) -> StepResult | None:
        """Carry out accelerations [m/s^2] and steering angles [rad] of the egos (B, 2) for a tick.

        None for episodes in which vehicles were commanded, and for states in double precision.
        """
        single = episode.state.x.dtype == episode.measure_state.dtype == torch.float32
        if not single or episode.overridden is not None or episode.statistics is None:
            return None
        # the module is not kept: a step is copied and sent
        result: StepResult = import_compiler().advance(episode, physical.numpy(), self._numbers)
        return result


def find_scripted_step(world: World, core: str = "auto") -> ScriptedStep | None:
    """Return the compiled steps of a world; None if torch has to carry them out, a ValueError with "numba"."""
    check_name("core", core, CORES)
    if core == "torch":
        return None
    try:
        return ScriptedStep(world)
    except NotCompiled as reason:
        leave_to_torch(reason, core, stacklevel=3)
    return None
