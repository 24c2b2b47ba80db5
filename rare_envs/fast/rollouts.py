"""Rollouts of the scripted scenarios, compiled by numba: from the traffic at time 0 to f, block by block of rows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rare_envs.control.idm import IDM
from rare_envs.fast import scripts
from rare_envs.fast.compilation import compiled, single
from rare_envs.fast.dense_policy import DensePolicy
from rare_envs.fast.equations import IDMNumbers, RoadNumbers
from rare_envs.fast.networks import LANES, PolicyNumbers, decide_by_policy
from rare_envs.fast.rows import UNKNOWN, SingleArray, begin, decide_by_idm, make_table, rows_of, stack_state, tick
from rare_envs.scenarios.cut_in import CUTTER_IDM
from rare_envs.traffic.road import Road
from rare_envs.traffic.state import State

ROWS = 256
"""Rows in a block with the IDM as ego: enough that starting a loop costs little, and in the processor's first cache."""


def drive(script: str, state: State, ego: IDM | DensePolicy, road: Road, dt: float, ticks: int) -> NDArray[np.float64]:
    """Return f of B scenarios, NaN where a policy's outputs are not finite.

    Args:
        script: A name in `rare_envs.fast.scripts`.
        state: At time 0.
        ego: The ego.
        road: A straight road with equal lanes.
        dt: Tick [s].
        ticks: Length of an episode.
    """
    start, vehicles, f = stack_state(state), state.x.shape[1], np.empty(len(state.x), dtype=np.float32)
    (tick_length,) = single(dt)
    table = make_table(start, vehicles, min(ROWS, max(len(f), 1)) if isinstance(ego, IDM) else LANES)
    world = (getattr(scripts, script), IDMNumbers.of(CUTTER_IDM), RoadNumbers.of(road), tick_length, ticks)
    if isinstance(ego, IDM):
        drive_by_idm(start, table, vehicles, IDMNumbers.of(ego), *world, f)
    else:
        policy = PolicyNumbers.of(ego)
        values, spare = np.zeros((2, policy.widths.max(), LANES), dtype=np.float32)
        drive_by_policy(start, table, vehicles, policy, values, spare, *world, f)
    return np.where(f == UNKNOWN, np.nan, f.astype(np.float64))


@compiled
def drive_by_idm(
    start: SingleArray,
    table: SingleArray,
    vehicles: int,
    idm: IDMNumbers,
    script: int,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f of each row.

    Args:
        start: The traffic at time 0, by `stack_state`.
        table: Room for a block of rows, by `make_table`.
        vehicles: N.
        idm: Of the ego.
        script: A number of `rare_envs.fast.scripts`.
        cutter_idm: Of a cutter behind its lead.
        road: The road.
        dt: Tick [s].
        ticks: Length of an episode.
        f: Shape (B,), written to.
    """
    for first in range(0, len(f), table.shape[1]):
        rows = rows_of(table, vehicles, load(start, table, first))
        turns = begin(rows, road)
        for _ in range(ticks):
            decide_by_idm(rows, turns, idm)
            turns = tick(script, rows, turns, cutter_idm, road, dt)
        for row in range(rows.size):
            f[first + row] = rows.f[row]


@compiled
def drive_by_policy(
    start: SingleArray,
    table: SingleArray,
    vehicles: int,
    policy: PolicyNumbers,
    values: SingleArray,
    spare: SingleArray,
    script: int,
    cutter_idm: IDMNumbers,
    road: RoadNumbers,
    dt: float,
    ticks: int,
    f: SingleArray,
) -> None:
    """Write f of each row; arguments as of `drive_by_idm` and `decide_by_policy`."""
    for first in range(0, len(f), table.shape[1]):
        rows = rows_of(table, vehicles, load(start, table, first))
        begin(rows, road)
        for _ in range(ticks):
            decide_by_policy(rows, policy, values, spare)
            tick(script, rows, True, cutter_idm, road, dt)
        for row in range(rows.size):
            f[first + row] = rows.f[row]


@compiled
def load(start: Any, table: Any, first: int) -> int:
    """Copy rows from number `first` on into a table; return how many."""
    size: int = min(table.shape[1], start.shape[1] - first)
    for number in range(len(start)):
        for row in range(size):
            table[number, row] = start[number, first + row]
    return size
