"""Which cut-ins of UN Regulation 157's grid can each reference driver prevent, and where does the JRC's code differ?

    python -m benchmarks.driving.reference_grid --reference FOLDER

FOLDER is a checkout of github.com/ec-jrc/JRC-FSM, whose verdicts are those of the Regulation's comparison; without it
only ours are found. Ego speed x speed of the cutter x gap are the JRC's grid, each at three speeds across. A cutter at
constant speed in the next lane, 1.6 m between the sides, speeds up across by 1.5 m/s^2, has the gap when it leaves the
middle of its lane, and stops across in front of the ego. Between dangers the ego keeps its speed, as theirs does.

Where the verdicts differ, and why:

* alks, fsm and rss crash in some cells in which theirs do not, hardly ever the other way round. The bodies here are 5 m
  long, theirs 4.3 m, so a cutter beside the ego is touched for longer: all that differs for alks, of which every tick
  is the same. fsm and rss also go by the speed across, which is seen from the last tick here and read from the next one
  there: they notice a cutter that speeds up across one or two ticks later, 0.1 to 0.2 s, at the edge of the cells.
* cc_human is another reading: theirs begins when the bodies overlap across, ours 0.4 s after 0.375 m, which is sooner
  at slow cut-ins ("only theirs crashes"). And theirs ends each run at an overlap with TTC > 2 s as prevented, where
  ours goes on at its speed and has to brake at 2 s; with car following most of these are prevented.
"""

import importlib
import itertools
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

import rare_envs
from benchmarks import RESULTS
from rare_envs.distributions.space import Parameter
from rare_envs.egos.reference import REFERENCE_EGOS
from rare_envs.scenarios.base import Others, Scenario, columns
from rare_envs.simulation.settings import Clock
from rare_envs.simulation.world import World, rollout
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import VEHICLE_LENGTH, VEHICLE_WIDTH, State

RESULT = RESULTS / "reference_grid.json"
LATERAL_SPEEDS = (0.6, 1.2, 1.8)
"""[m/s]; the last is the largest of people's changes that the Regulation has."""
LATERAL_ACCELERATION = 1.5
"""[m/s^2]."""
SIDE_GAP = 1.6
"""Between the sides of vehicles in the middle of their lanes [m]."""
OFFSET = SIDE_GAP + VEHICLE_WIDTH
"""Distance of the lanes' middles [m]."""
HORIZON = 34.9
"""[s], the JRC's 350 ticks less the first."""
TICK = 0.1
"""[s], as theirs."""
THEIRS = {"cc_human": "CC", "alks": "Reg157", "fsm": "FSM", "rss": "RSS"}
"""Prefixes of the models in the JRC's code."""


def list_cells() -> NDArray[np.float64]:
    """Return the cells: speeds of ego and cutter [km/h], gap [m], speed across [m/s], shape (cells, 4)."""
    low = [(ego, other) for ego in range(10, 61, 10) for other in range(10, ego, 10)]
    high = [(ego, other) for ego in range(70, 131, 20) for other in range(10, ego, 30)]
    pairs = [(pair, range(1, 60)) for pair in low] + [(pair, range(1, 120, 2)) for pair in high]
    rows = [(*pair, gap, across) for pair, gaps in pairs for gap, across in itertools.product(gaps, LATERAL_SPEEDS)]
    return np.array(rows, dtype=np.float64)


def initial(x: Tensor) -> State:
    """Place the cutter a tick before it begins to move across; theta is its speed across, and the largest one."""
    ego, other, gap, across = x.unbind(1)
    zero, lead_time = torch.zeros_like(gap), across / LATERAL_ACCELERATION
    return State(
        x=columns(zero, gap + VEHICLE_LENGTH + (ego - other) * (lead_time + TICK)),
        y=columns(zero, OFFSET + across * (lead_time - TICK) / 2.0),  # the way in Euler's steps
        heading=columns(zero, zero),
        speed=columns(ego, other),
        theta=columns(zero - LATERAL_ACCELERATION * TICK, across),
    )


def others(state: State, dt: float) -> Others:
    """Move the cutter along, and across until it is in front of the ego; it does not turn, as theirs does not."""
    now, most = state.theta.unbind(1)
    x, y, speed = state.x[:, 1], state.y[:, 1], state.speed[:, 1]
    after = (y - now.clamp_min(0.0) * dt).clamp_min(0.0)
    now = torch.minimum(now + LATERAL_ACCELERATION * dt, most)
    x, y, heading, speed = (each[:, None] for each in (x + speed * dt, after, torch.zeros_like(x), speed))
    return Others(x, y, heading, speed, theta=columns(now, most))


def make_scenario() -> Scenario:
    """Return the Regulation's cut-in, in lanes with 1.6 m between the sides."""
    box = (("ego_speed", 0.0, 40.0), ("cut_in_speed", 0.0, 40.0), ("gap", 0.0, 200.0), ("across", 0.0, 3.0))
    return Scenario(
        name="regulation_157_cut_in",
        road=Road(edges=(-OFFSET / 2, OFFSET / 2, 1.5 * OFFSET)),
        vehicle_names=("ego", "cutter"),
        horizon=HORIZON,
        parameters=tuple(Parameter(name, "", low, high, "of the grid") for name, low, high in box),
        bases={"none": {}},
        initial=initial,
        others=others,
        driven=lambda state, action, dt: others(state, dt),
    )


def find_ours(name: str, cells: NDArray[np.float64], cruise: bool) -> NDArray[np.bool_]:
    """Return in which cells one of our drivers collides."""
    world, ego = World(make_scenario(), clock=Clock(dt=TICK)), REFERENCE_EGOS[name]
    x = torch.from_numpy(cells / np.array([3.6, 3.6, 1.0, 1.0]))
    driver = replace(ego, model=replace(ego.model, cruise=cruise)).in_world(world)
    collided: NDArray[np.bool_] = rollout(world, driver, x).collided.numpy()
    return collided


def find_theirs(name: str, cells: NDArray[np.float64], folder: Path) -> NDArray[np.bool_]:
    """Return in which cells the JRC's code has a crash: its functions, called as its comparison of cut-ins does."""
    sys.path.insert(0, str(folder))
    models, movement, common = (
        importlib.import_module(f"utility.{each}") for each in ("models", "movement", "global_parameters")
    )
    kind = THEIRS[name]
    check = getattr(models, f"{kind}_check_safety_cut_in", None) or getattr(models, f"{kind}_check_safety")
    react = getattr(models, f"{kind}_react")
    return np.array([_crash_of(cell, movement, common, check, react) for cell in cells])


def _crash_of(cell: NDArray[np.float64], movement: Any, common: Any, check: Any, react: Any) -> bool:
    """Return whether the JRC's code crashes in a cell; its cutter speeds up across before it has the gap."""
    ego_speed, other_speed, gap, across = cell
    rate, n = common.freq, common.iterations
    ramp = np.arange(0.0, across, LATERAL_ACCELERATION / rate)
    vehicles = []
    for speed, place, side, inward in (
        (ego_speed / 3.6, 0.0, 0.0, 0.0),
        (other_speed / 3.6, gap + common.length, SIDE_GAP + common.width, 1.0),
    ):
        vehicle = movement.create_profile_cutting_in(np.array([place, side]), speed, -inward * across, n, rate)
        along, sideways = np.full(len(ramp), speed), -inward * ramp  # before it has the gap
        for profile, value, last, rates in (
            ("long", speed, place, along),
            ("lat", -inward * across, side, sideways),
        ):
            places = np.append(last - np.cumsum(rates[::-1])[::-1] / rate, last)
            for kind, earlier in (("pos", places), ("speed", np.append(rates, value))):
                name = f"{kind}_profile_{profile}"
                setattr(vehicle, name, np.concatenate((earlier, getattr(vehicle, name))))
        vehicle.width, vehicle.length, vehicle.large_TTC = common.width, common.length, False
        vehicles.append(vehicle)
    ego, cutter = vehicles
    for tick in range(len(ego.pos_profile_long) - 1):
        movement.control(ego, cutter, rate, check, react, tick)
        if ego.crash or ego.large_TTC:
            break
    return bool(ego.crash)


def main(
    reference: Annotated[Path | None, typer.Option(help="checkout of github.com/ec-jrc/JRC-FSM")] = None,
    out: Annotated[Path, typer.Option(help="the JSON file")] = RESULT,
) -> None:
    """Ask every driver about every cell and write the counts and the cells in which the verdicts differ."""
    cells = list_cells()
    record: dict[str, Any] = {
        "command": "python -m benchmarks.driving.reference_grid --reference JRC-FSM",
        "version": rare_envs.__version__,
        "columns": ["ego speed [km/h]", "speed of the cutter [km/h]", "gap [m]", "speed across [m/s]"],
        "cells": len(cells),
        "drivers": {},
    }
    for name in THEIRS:
        ours, followed = (find_ours(name, cells, cruise) for cruise in (False, True))
        found: dict[str, Any] = {
            "unpreventable": int(ours.sum()),
            "unpreventable with car following": int(followed.sum()),
        }
        if reference is not None:
            theirs = find_theirs(name, cells, reference)
            found["unpreventable by the JRC's code"] = int(theirs.sum())
            found["same verdict"] = round(float((ours == theirs).mean()), 4)
            for words, differ in {"only ours crashes": ours & ~theirs, "only theirs crashes": theirs & ~ours}.items():
                found[words] = {
                    "cells": int(differ.sum()),
                    "by speed across": {str(v): int((differ & (cells[:, 3] == v)).sum()) for v in LATERAL_SPEEDS},
                    "cells with them": [[float(f"{each:g}") for each in cell] for cell in cells[differ]],
                }
        record["drivers"][name] = found
        print(name, {key: value for key, value in found.items() if not isinstance(value, dict)})
    out.write_text(json.dumps(record) + "\n")


if __name__ == "__main__":
    typer.run(main)
