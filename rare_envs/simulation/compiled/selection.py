"""Selection: which worlds have a compiled rollout, and its numbers."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rare_envs.control.idm import IDM
from rare_envs.measures import MEASURES
from rare_envs.plugins import one_line
from rare_envs.scenarios import car_following, cut_in, hard_brake
from rare_envs.simulation.compiled.dense_policy import DensePolicy
from rare_envs.simulation.compiled.failures import CompilerFails, NotCompiled, compiler_failures
from rare_envs.simulation.observation import EGO_FEATURES, OTHER_FEATURES

if TYPE_CHECKING:
    from rare_envs.scenarios.base import Scenario
    from rare_envs.simulation.world import World
    from rare_envs.traffic.road import Road

COMPILED_SCRIPTS = {
    "car_following": (car_following.initial, car_following.others),
    "cut_in": (cut_in.initial, cut_in.others),
    "hard_brake": (hard_brake.initial, hard_brake.others),
}
"""Names of compiled scripts to the initial state and the motion of the other vehicles that they have."""


CompiledEgo = IDM | Callable[[], DensePolicy]
"""An ego that compiled rollouts carry out: the IDM, or what reads the network of a policy with its present
weights."""


@dataclass(frozen=True)
class CompiledRollout:
    """The rollouts of a world and its ego, compiled: called with x (B, d), it returns f (B,).

    It keeps no compiled code, so that it can be sent to other processes.

    Example:
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> from rare_envs.simulation import World
        >>> rollout = find_compiled_rollout(World(CAR_FOLLOWING), IDM())
        >>> rollout(np.array([[20.0, 15.0, 30.0], [30.0, 5.0, 20.0]])).tolist()  # 30 m / (5 m/s), and a collision
        [6.0, -1.0]
    """

    script: str
    """One of `COMPILED_SCRIPTS`."""
    ego: CompiledEgo
    road: Road
    dt: float
    """Tick [s]."""
    ticks: int

    def __call__(self, x: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return f of scenarios x (B, d) within the physical box; NaN where a policy's outputs are not finite.

        Raises:
            NotCompiled: The policy has been changed, and is no longer one that is compiled.
            CompilerFails: numba does not work in this process.
        """
        ego = self.ego if isinstance(self.ego, IDM) else self.ego()
        arguments = (self.road, self.dt, self.ticks)
        with compiler_failures():
            from rare_envs.simulation.compiled import policy_rollouts, scripted_rollouts

            if isinstance(ego, IDM):
                return scripted_rollouts.drive_by_idm(self.script, x, ego, *arguments)
            return policy_rollouts.drive_by_policy(self.script, x, ego, *arguments)


def find_compiled_rollout(world: World, ego: CompiledEgo) -> CompiledRollout:
    """Return the compiled rollout of a world and its ego.

    Args:
        world: The world.
        ego: The ego; a policy is read, and refused by an error of its own.

    Raises:
        NotCompiled: There is none, or numba is missing.
        CompilerFails: numba cannot be used here.

    Example:
        >>> from rare_envs.scenarios.highway import HIGHWAY
        >>> from rare_envs.simulation import World
        >>> find_compiled_rollout(World(HIGHWAY), IDM())
        Traceback (most recent call last):
            ...
        rare_envs.simulation.compiled.failures.NotCompiled: the script of the scenario 'highway' is not compiled
    """
    found = select_rollout(world, ego)
    _import_compiler()
    return found


def select_rollout(world: World, ego: CompiledEgo) -> CompiledRollout:
    """Return `find_compiled_rollout`, whether numba can be used here or not.

    Raises:
        NotCompiled: There is none.
    """
    obstacle = _find_obstacle(world)
    if obstacle:
        raise NotCompiled(obstacle)
    scenario, clock = world.scenario, world.clock
    if not isinstance(ego, IDM):
        obstacle = _find_policy_obstacle(world, ego())
        if obstacle:
            raise NotCompiled(obstacle)
    return CompiledRollout(_find_script(scenario), ego, scenario.road, clock.dt, clock.ticks)


def find_compiled_script(world: World) -> str:
    """Return the name of the compiled script that an environment's world follows, with statistics or without.

    Raises:
        NotCompiled: It follows none, or numba is missing.
        CompilerFails: numba cannot be used here.
    """
    plain = replace(world, measurement=replace(world.measurement, statistics=False))
    obstacle = _find_obstacle(plain)
    if obstacle or world.uses_lidar or "camera" in world.sensing.kinds:
        raise NotCompiled(obstacle or f"the observation {world.sensing.observation!r} is not compiled")
    _import_compiler()
    return _find_script(world.scenario)


def _find_policy_obstacle(world: World, policy: DensePolicy) -> str:
    """Return why the torch simulation is needed with a policy as ego; empty if it is not."""
    if world.sensing.observation != "features":
        return f"the observation {world.sensing.observation!r} is not compiled"
    if world.clock.action == "meta":
        return f"the action {world.clock.action!r} is not compiled"
    obstacle = policy.describe_obstacle(len(EGO_FEATURES) + len(OTHER_FEATURES) * (world.scenario.vehicles - 1))
    return f"{obstacle} is not compiled" if obstacle else ""


def _find_obstacle(world: World) -> str:
    """Return why the torch simulation of a script is needed, whatever the ego; empty if it is not."""
    scenario, measurement = world.scenario, world.measurement
    obstacles = {
        "worlds with drivers are not compiled": world.background is not None,
        f"the script of the scenario {scenario.name!r} is not compiled": not _find_script(scenario),
        "curved roads and lanes of different widths are not compiled": scenario.road.reference_line is not None
        or not scenario.road.equal,
        f"the measure {measurement.measure!r} is not compiled": measurement.episode_measure != MEASURES["ttc"],
        "statistics of episodes are not compiled": measurement.statistics,
        "collisions of other vehicles are not compiled": measurement.collisions != "ego",
        "parameters of the weather are not compiled": sum(world.columns) != scenario.size,
    }
    return next((words for words, found in obstacles.items() if found), "")


def _find_script(scenario: Scenario) -> str:
    """Return the name of the compiled script of a scenario; empty if it has none."""
    for name, (initial, others) in COMPILED_SCRIPTS.items():
        if scenario.initial is initial and scenario.others is others:
            return name
    return ""


def _import_compiler() -> None:
    """Import what needs numba.

    Raises:
        NotCompiled: It is not installed.
        CompilerFails: It is, but fails: with this NumPy, or since it can write its cache nowhere.
    """
    if importlib.util.find_spec("numba") is None:
        raise NotCompiled("numba is not installed: pip install 'rare-envs[driving]'")
    try:
        from rare_envs.simulation.compiled import policy_rollouts, scripted_rollouts  # noqa: F401
    except (ImportError, OSError, RuntimeError) as error:
        raise CompilerFails(f"numba is installed, but fails here: {one_line(error)}") from error
