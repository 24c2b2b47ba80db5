"""Encounters of this project's scenarios as scenes, in which a driver is trained as in recorded ones.

The ego is driven by IDM when a scene is made, and by the trained driver later; the others are replayed. One scene holds
many encounters one behind the other on one road, too far apart to perceive each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.control.idm import IDM
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import scenario_named
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.rollout import drive
from rare_envs.simulation.world import World
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH
from training.data.scenes import TrafficScene
from training.egos.nominal_driving import draw_inputs, make_world
from training.egos.nominal_traffic import CASES

APART = 1500.0
"""Distance of neighbouring encounters at their start [m], several times the range of every sensor."""
SCENE_VEHICLES = 39
"""Most vehicles of a scene."""


@dataclass(frozen=True)
class EncounterSpec:
    """Settings of encounters of one kind."""

    scenario: str
    """Short name or id of a scenario, or one of `training.egos.nominal_traffic.CASES` on a straight road."""
    base: str | None = None
    """Base distribution of the scenario."""
    scenes: int = 1
    """Number of scenes."""
    seconds: float = 6.0
    """Length [s]; the others keep their speed afterwards."""
    given: Mapping[str, float] = field(default_factory=dict)
    """Parameters with a fixed value."""


def make_scenes(kinds: Sequence[EncounterSpec], rng: np.random.Generator) -> list[TrafficScene]:
    """Return scenes full of encounters; every other one is mirrored, since scenarios have one side only.

    Args:
        kinds: Settings of each kind.
        rng: Source of their parameters.
    """
    scenes = []
    for kind in kinds:
        world = _make_world(kind)
        each = SCENE_VEHICLES // world.scenario.vehicles
        tracks = _simulate_tracks(world, _draw_parameters(kind, world, each * kind.scenes, rng))
        for number in range(kind.scenes):
            rows = slice(number * each, (number + 1) * each)
            side = -1.0 if number % 2 else 1.0
            name = f"{kind.scenario} {kind.base or ''} {number}"
            scenes.append(_make_scene(name, world, tracks[:, rows], side))
    return scenes


def _make_world(kind: EncounterSpec) -> World:
    """Return the world of one kind."""
    if kind.scenario in CASES:
        return make_world(CASES[kind.scenario], kind.seconds)
    return World(scenario_named(kind.scenario), clock=Clock(horizon=kind.seconds))


def _draw_parameters(kind: EncounterSpec, world: World, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw n rows of x, from the base or the starts of ordinary traffic."""
    if kind.scenario in CASES:
        x = draw_inputs(CASES[kind.scenario], world, n, 0, rng)
    else:
        x = np.asarray(load_base(world.scenario, kind.base).sample(n, rng))
    names = [parameter.name for parameter in world.scenario.parameters]
    for name, value in kind.given.items():
        x[:, names.index(name)] = value
    return x


def _simulate_tracks(world: World, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x, y, heading and speed of all vehicles with IDM as ego, shape (T, n, N, 4)."""
    with torch.inference_mode():
        states = [episode.state for episode in drive(world, IDM(), torch.from_numpy(x))]
        moments = [torch.stack((s.x, s.y, s.heading, s.speed), dim=-1) for s in states]
    return np.asarray(torch.stack(moments).numpy())


def _make_scene(name: str, world: World, tracks: NDArray[np.float64], side: float) -> TrafficScene:
    """Return one scene of some encounters (T, n, N, 4), mirrored for side = -1."""
    road, (ticks, n, vehicles, _) = world.scenario.road, tracks.shape
    place = APART * np.arange(n)[:, None]
    flat: dict[str, Any] = {
        "x": tracks[..., 0] + place,
        "y": side * tracks[..., 1],
        "heading": side * tracks[..., 2],
        "speed": tracks[..., 3],
    }
    flat = {key: values.reshape(ticks, n * vehicles) for key, values in flat.items()}
    ego = np.arange(n * vehicles) % vehicles == 0
    # vehicles without actions are replayed; the actions of the ego are not learned from, so zeros do
    action = np.where(ego, 0.0, np.nan) * np.ones((ticks, 1))
    return TrafficScene(
        name=name,
        start=0.0,
        edges=tuple(sorted(side * edge for edge in road.edges)),
        **flat,
        acceleration=action,
        yaw_rate=action.copy(),
        present=np.ones((ticks, n * vehicles), dtype=bool),
        length=np.full(n * vehicles, VEHICLE_LENGTH),
        width=np.full(n * vehicles, VEHICLE_WIDTH),
    )
