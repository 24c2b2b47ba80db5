"""Choice of what simulates: which worlds and egos are compiled, and the calls of what is. It needs no numba itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.idm import IDM
from rare_envs.egos.dense_policies import read_dense_policy
from rare_envs.egos.policy import PolicyDriver
from rare_envs.fast.dense_policy import DensePolicy, NotCompiled
from rare_envs.measures import MEASURES
from rare_envs.plugins import one_line
from rare_envs.scenarios import car_following, cut_in, hard_brake
from rare_envs.simulation.observation import EGO_FEATURES, OTHER_FEATURES

if TYPE_CHECKING:
    from rare_envs.scenarios.base import Scenario
    from rare_envs.simulation.rollout import Driver
    from rare_envs.simulation.world import World

CORES = ("auto", "torch", "numba")
"""Choices of what simulates."""
SCRIPTS = ((car_following.others, "STEADY", 2), (hard_brake.others, "BRAKING", 2), (cut_in.others, "CUT_IN", 3))
"""Motions of the other vehicles, names of their compiled twins in `rare_envs.fast.scripts`, and how many vehicles these
are for, the ego included."""


class CompilerFails(NotCompiled):
    """numba does not work here."""


def check_core(core: str) -> None:
    """Raise a ValueError if there is no such core."""
    if core not in CORES:
        raise ValueError(f"Expected core to be one of {', '.join(map(repr, CORES))}, got {core!r}.")


def is_compiled(world: World, driver: Driver) -> bool:
    """Return whether a world is a script that is compiled with this ego, whether numba works here or not."""
    try:
        find_script(world)
        read_ego(world, driver)
    except NotCompiled:
        return False
    return True


def simulate(world: World, driver: Driver, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return f of scenarios x (B, d) within the physical box; NaN where a policy's outputs are not finite.

    Raises:
        NotCompiled: The world or the ego is not compiled.
        CompilerFails: numba does not work here.
    """
    script, ego = find_script(world), read_ego(world, driver)
    import_compiler()
    from rare_envs.fast import rollouts

    with torch.inference_mode():
        state = world.scenario.initial(torch.from_numpy(x).float())
    try:
        return rollouts.drive(script, state, ego, world.scenario.road, world.clock.dt, world.clock.ticks)
    except Exception as error:  # numba compiles at the first call, where anything may be raised
        raise CompilerFails(f"numba fails here: {one_line(error)}") from error


def find_script(world: World) -> str:
    """Return the name of the compiled script of a world.

    Raises:
        NotCompiled: It has none, or something in the world is not compiled.
    """
    scenario, measurement = world.scenario, world.measurement
    known = [(name, vehicles) for others, name, vehicles in SCRIPTS if scenario.others is others]
    names = [name for name, vehicles in known if scenario.vehicles == vehicles]
    obstacles = {
        "worlds with drivers are not compiled": world.background is not None,
        f"the script of the scenario {scenario.name!r} is not compiled": not known,
        f"the script of {scenario.name!r} is not compiled for {scenario.vehicles} vehicles": not names,
        "curved roads and lanes of different widths are not compiled": scenario.road.reference_line is not None
        or not scenario.road.equal,
        f"the measure {measurement.measure!r} is not compiled": measurement.episode_measure != MEASURES["ttc"],
        "statistics of episodes are not compiled": measurement.statistics,
        "collisions of other vehicles are not compiled": measurement.collisions != "ego",
        "parameters of the weather are not compiled": sum(world.columns) != scenario.size,
    }
    for words, found in obstacles.items():
        if found:
            raise NotCompiled(words)
    return names[0]


def read_ego(world: World, driver: Driver) -> IDM | DensePolicy:
    """Return an ego as it is compiled, a policy with its present weights.

    Raises:
        NotCompiled: It is not.
    """
    if type(driver) is IDM:
        return driver
    if type(driver) is not PolicyDriver:
        raise NotCompiled(f"the ego, a {type(driver).__name__}, is not compiled")
    policy = read_dense_policy(driver.policy)
    if world.sensing.observation != "features":
        raise NotCompiled(f"the observation {world.sensing.observation!r} is not compiled")
    if world.clock.action == "meta":
        raise NotCompiled(f"the action {world.clock.action!r} is not compiled")
    obstacle = policy.describe_obstacle(count_features(world.scenario))
    if obstacle:
        raise NotCompiled(f"{obstacle} is not compiled")
    return policy


def find_step_script(world: World) -> str:
    """Return the name of the compiled script that an environment's world follows, with statistics or without.

    Raises:
        NotCompiled: As `find_script`, or for what is observed or done.
    """
    script = find_script(replace(world, measurement=replace(world.measurement, statistics=False)))
    if world.uses_lidar or "camera" in world.sensing.kinds:
        raise NotCompiled(f"the observation {world.sensing.observation!r} is not compiled")
    if world.clock.action == "meta":
        raise NotCompiled("meta-actions are not compiled")
    return script


def count_features(scenario: Scenario) -> int:
    """Return the number of features that an ego observes."""
    return len(EGO_FEATURES) + len(OTHER_FEATURES) * (scenario.vehicles - 1)


@cache
def import_compiler() -> None:
    """Import what needs numba.

    Raises:
        CompilerFails: numba is missing or fails: with this NumPy, or since it is switched off.
    """
    try:
        from rare_envs.fast import rollouts, steps  # noqa: F401
    except (ImportError, OSError, RuntimeError) as error:
        raise CompilerFails(f"numba fails here: {one_line(error)}") from error
