"""World and scenario space from the keyword arguments of `gym.make`."""

import inspect
from collections.abc import Mapping, Sequence
from os.path import isfile
from typing import Any

import numpy as np
import torch

from rare_envs.control.actions import ACTIONS
from rare_envs.distributions.fitted import join_independent
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.egos.needs import EgoNeeds
from rare_envs.egos.policy import find_policies, split_drivers
from rare_envs.measures.registry import load_measure
from rare_envs.plugins import check_name, did_you_mean, make_object, names_object
from rare_envs.scenarios.base import Scenario, load_base
from rare_envs.scenarios.registry import SCENARIOS, find_scenario, split_layout
from rare_envs.sensors.camera import find_camera
from rare_envs.simulation.background import find_drivers
from rare_envs.simulation.observation import read_kinds
from rare_envs.simulation.settings import Clock, Measurement, Sensing
from rare_envs.simulation.world import World, noise_block

NO_NEEDS = EgoNeeds()
CONFIGURATION_ARGUMENTS = {
    "duration": "horizon",
    "simulation_frequency": "dt",
    "policy_frequency": "action",
    "observation": "observation",
    "type": "observation or action",
    "action": "action",
    "other_vehicles_type": "drivers",
}
"""The keyword argument of gym.make that sets what a key of HighwayEnv's configuration tells."""


def set_up(
    scenario: Scenario | str,
    needs: EgoNeeds = NO_NEEDS,
    /,
    *,
    observation: str | list[str] | tuple[str, ...] = "features",
    action: str = "continuous",
    measure: Any = "ttc",
    horizon: float | None = None,
    dt: float = 0.1,
    base: Any = None,
    drivers: Any = None,
    noise: bool | str = True,
    collisions: str = "ego",
    camera: Any = None,
    weather: bool = False,
    trust: bool = False,
    **unknown: Any,
) -> tuple[World, ScenarioSpace]:
    """Return the world and the scenario space of an environment.

    Args:
        scenario: The scenario or its environment's id, for example "rare_envs/CutIn-v0".
        needs: What the ego needs beside the keyword arguments.
        observation: "features", "lidar", "kinematics" (HighwayEnv's) or "camera"; several, such as "camera+lidar" or
            ("camera", "lidar"), make a `Dict`.
        action: "continuous"; "discrete", five accelerations for algorithms such as DQN, see
            `rare_envs.control.actions.DISCRETE_ACTIONS`; or "meta" (HighwayEnv's, see
            `rare_envs.control.actions`: a step is then one second).
        measure: The safety measure: a name in `rare_envs.measures.MEASURES`, "stl:FORMULA", "module:name", a
            `Measure` or another of its kind, or a function; see `rare_envs.measures.find_measure`.
        horizon: Length of an episode [s]; None takes the scenario's.
        dt: Tick [s].
        base: Distribution of the scenario's own parameters: the name of a shipped one, the path of a JSON file, or a
            distribution object; None takes the scenario's default.
        drivers: Drivers of the vehicles around the ego: "mgail", "mgail?rules=0", "gail", "idm", "idm+mobil"
            (which changes lanes too), the path of a driver's file, a `Background` or a `TrafficBackground`, or
            "module:name" of what makes one; or policies in single vehicles, see `rare_envs.egos.policy.find_policies`.
            None takes the scenario's default, which is its script but for the highway. The weights of learned drivers
            are parameters of the scenario.
        noise: What becomes of the drivers' noise. True: it is part of x, standard normal columns behind the others.
            "fixed": one sequence for all x, so that probabilities are conditional on it. False: mean actions.
        collisions: Which count: those of the "ego", or "any", those between two other vehicles too.
        camera: Of the observation "camera": a `rare_envs.sensors.camera.Camera`, or the size (height, width) of its
            pictures; None for 66 x 200.
        weather: Whether weather and the camera's noise are part of x, see `rare_envs.sensors.camera`; without
            it there is a clear day. Weather does not change the traffic.
        trust: Whether the files of policies in `drivers` may run code, see `agents.load_ego`.
        **unknown: Any other argument, which is refused.

    Returns:
        The world and the space of its parameters.
    """
    if isinstance(scenario, str):
        env_id, layout = split_layout(scenario)
        if layout:
            told = " and ".join(f"{name} {value!r}" for name, value in layout.items())
            raise ValueError(f"{scenario!r} is for gym.make and gym.make_vec; here take {env_id!r} with {told}.")
        scenario = find_scenario(env_id)
    refuse_unknown(scenario, unknown)
    kinds = read_kinds(observation)
    check_name("action", action, ACTIONS)
    if not isinstance(weather, bool):
        raise ValueError(f"Expected weather True or False, got {weather!r}.")
    if isinstance(drivers, str) and names_object(drivers) and not (isfile(drivers) or split_drivers(drivers)):
        drivers = make_object(drivers, "drivers")
    policies = find_policies(drivers, scenario, trust)
    background = find_drivers(scenario.drivers if drivers is None or policies else drivers)
    lidar = needs.lidar or any("lidar" in policy.driver.observation for policy in policies)
    world = World(
        scenario,
        sensing=Sensing(kinds, find_camera(camera), weather, lidar),
        background=background,
        policies=policies,
        measurement=Measurement(load_measure(measure), collisions),
        clock=Clock(dt, scenario.horizon if horizon is None else horizon, action),
        noise=noise,
    )
    space = build_space(world, load_base(scenario, base), needs.noise_columns(world))
    if not isinstance(world.measurement.measure, str):
        _try_measure(world, space)
    return world, space


def refuse_unknown(scenario: Scenario, arguments: Mapping[str, Any], more: Sequence[str] = ()) -> None:
    """Raise a TypeError if a keyword argument is neither one of `set_up` nor one of `more`; the message lists both."""
    own = [word for word in inspect.signature(set_up).parameters if word not in ("scenario", "needs", "unknown")]
    known = [*more, *own]
    for name in (name for name in arguments if name not in known):
        if name == "config":
            ours = ", ".join(f"{argument} ({key})" for key, argument in CONFIGURATION_ARGUMENTS.items())
            raise TypeError(f"Expected keyword arguments in place of HighwayEnv's config: {ours}; the rest is fixed.")
        of_reset = name in (parameter.name for parameter in scenario.parameters)
        hint = " (reset takes it as an option)" if of_reset else did_you_mean(name, known)
        env_id = next((each for each, registered in SCENARIOS.items() if registered is scenario), scenario.name)
        raise TypeError(f"{env_id} takes no keyword argument {name!r}{hint}; it takes {', '.join(known)}.")


@torch.inference_mode()
def _try_measure(world: World, space: ScenarioSpace) -> None:
    """Evaluate a user's measure on two drives of one tick, so that a broken one is found before the simulations."""
    drawn = space.sample(2, np.random.default_rng(0))
    x = torch.from_numpy(drawn[:, : world.dim]).float()  # the ego, whose noise is behind, is not asked
    measure = world.measurement.measure
    try:
        f = world.step(world.start(x), torch.zeros(2, 2)).f
    except Exception as error:  # the function is the user's: anything may happen in it
        raise ValueError(f"The measure {measure!r} fails on two ordinary scenarios: {error}") from error
    if not bool(torch.isfinite(f).all()):
        raise ValueError(f"Expected finite numbers from the measure {measure!r}, got {f.tolist()}.")


def build_space(world: World, base: Distribution, ego_noise: int = 0) -> ScenarioSpace:
    """Return the parameters of a world: the scenario's (`base`), the weather's, drivers' weights, all noise."""
    blocks = [block for part in world.blocks.values() for block in part] + noise_block(
        "ego_noise", "of the ego", ego_noise
    )
    parameters = [*world.scenario.parameters, *(parameter for own, _ in blocks for parameter in own)]
    names = [p.name for p in parameters]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise ValueError(
            f"{world.scenario.name} has parameters of its own named {', '.join(sorted(twice))}, as weather or drivers "
            "have; rename them."
        )
    return ScenarioSpace(parameters, join_independent(base, *(distribution for _, distribution in blocks)))
