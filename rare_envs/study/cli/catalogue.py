"""Catalogue of the names that the command line takes: environments, methods, egos, measures, base distributions."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import gymnasium as gym

import samplers
from agents.learned.networks import HEAD_SIZE
from rare_envs.measures.base import Measure
from rare_envs.measures.episode_trace import TraceMeasure
from rare_envs.measures.registry import MEASURES
from rare_envs.scenarios.registry import SCENARIOS, kinematics_id
from rare_envs.sensors.camera.weather import CONDITIONS, SENSOR_NOISE
from rare_envs.simulation.background import noise_size

TICK = 0.1
"""[s], the usual one."""
EGOS = {
    "idm": "rule-based driver, Intelligent Driver Model (the default); with other parameters: idm?time_headway=2",
    "human": "attentive human driver by a published model with reaction time, errors and glances, docs/human_driver.md",
    "imitation": "shipped ego with lidar, learned from recorded traffic and from encounters",
    "mgail, gail, FILE.safetensors": "learned driver with lidar, by mean actions",
    "vision": "PilotNet on pictures of a front camera, which imitates a driver by rule; see docs/camera.md",
    "FILE.zip": "policy saved by Stable-Baselines3 or sb3-contrib, VecNormalize statistics beside it included",
    "hf:USER/REPOSITORY": "such a policy of the Hugging Face Hub, from its cache on this machine or downloaded",
    "FILE.onnx": "graph from observations to actions; rare-envs export-ego writes one of a .zip",
    "module:function": "what your function returns: any object with Stable-Baselines3's predict",
    "tcp://HOST:PORT": "program in any language, see docs/remote.md; rare-envs serve-ego serves one of these",
    "process:EGO": "one of these in a process of its own, for an ego that may hang or die",
    "noisy:EGO": "one of these behind the imperfections of a full stack, see docs/egos.md",
}
DRIVERS = {
    "mgail": "learned from recorded traffic by imitation, with rules of collision avoidance and lane changes",
    "mgail?rules=0": "its network alone, with the noise of recorded driving (the highway's default)",
    "gail": "a network learned by policy gradients, without rules",
    "idm": "rule-based driver, Intelligent Driver Model and lane keeping by what it sees",
    "idm+mobil": "the same, which changes lanes too, by MOBIL",
    "FILE.safetensors": "driver that you trained, see rare-envs train-drivers",
}


def list_names() -> dict[str, Any]:
    """Return everything that can be named on the command line, as JSON-ready values.

    Returns:
        "environments" (id to parameters, vehicles, bases, drivers and what learned drivers add to x, with their noise
        and for an episode of the usual length), "highway_env" (HighwayEnv's own ids that have parameters), "weather"
        (parameters that `--weather` adds), "methods", "egos", "drivers", "measures".
    """
    import highway_env  # noqa: F401  (registers its ids)

    from rare_envs.interop.scenario import SUPPORTED

    environments = {
        env_id: {
            "kinematics_id": kinematics_id(env_id),
            "parameters": [asdict(parameter) for parameter in scenario.parameters],
            "vehicles": list(scenario.vehicle_names),
            "bases": list(scenario.bases),
            "drivers": scenario.drivers,
            "of_learned_drivers": [
                {"name": "weights", "size": HEAD_SIZE},
                {"name": "noise", "size": noise_size(round(scenario.horizon / TICK), scenario.vehicles - 1)},
            ],
        }
        for env_id, scenario in SCENARIOS.items()
    }
    return {
        "environments": environments,
        "highway_env": [name for name in SUPPORTED if name in gym.registry],
        "weather": [asdict(parameter) for parameter in (*CONDITIONS, SENSOR_NOISE)],
        "methods": {name: _first_line(method) for name, method in samplers.METHODS.items()},
        "egos": EGOS,
        "drivers": DRIVERS,
        "measures": {
            name: _first_line(measure.of if isinstance(measure, Measure | TraceMeasure) else measure)
            for name, measure in MEASURES.items()
        },
    }


def _first_line(documented: object) -> str:
    """Return the first line of a docstring, as a noun: "Return the gap ..." becomes "Gap ..."."""
    line = (documented.__doc__ or "").strip().partition("\n")[0].removeprefix("Return ").removeprefix("the ")
    return line[:1].upper() + line[1:]
