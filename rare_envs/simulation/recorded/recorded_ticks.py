"""RecordedTicks: rollouts on the CPU, by ticks that are recorded once and played by NumPy."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils._python_dispatch import _get_current_dispatch_mode

from rare_envs.simulation.episode import Episode
from rare_envs.simulation.recorded.recordability import is_recordable
from rare_envs.simulation.recorded.tick_program import FILLED_ROWS, NotRecorded, TickProgram
from rare_envs.simulation.rollout import Driver, StochasticDriver, drive_tick
from rare_envs.simulation.world import World
from rare_envs.traffic.tensor_trees import map_tensors

MOST_WORLDS = 12
"""Whose ticks are kept; what was not simulated for longest goes first."""
_ONE_AT_A_TIME = threading.Lock()
"""Threads would add to the same program."""


_ANY = torch.empty(0)


class RecordedTicks:
    """Rollouts of a driver on the CPU, with the bits of `rollout`.

    Recorded is what may be (`is_recordable`), from the second call with a world on.

    Attributes:
        driver: The ego.

    Example:
        >>> from rare_envs.control.idm import IDM
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> rollouts, world, x = RecordedTicks(IDM()), World(CAR_FOLLOWING), torch.tensor([[20.0, 15.0, 30.0]])
        >>> with torch.inference_mode():
        ...     rollouts(world, x) is None, rollouts(world, x).f.tolist()
        (True, [6.0])
    """

    def __init__(self, driver: Driver) -> None:
        """Record nothing yet."""
        self.driver = driver
        self._known: list[_WorldTicks] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process can take over: all but the recordings."""
        return vars(self) | {"_known": []}

    def __call__(self, world: World, x: Tensor) -> Episode | None:
        """Drive B scenarios x (B, d) from start to horizon; None where `rollout` has to, as for the first time.

        It has to where gradients are taken, where somebody watches what torch does (a dispatch mode), and in double
        precision: the numbers in a recording are single.
        """
        watched = torch.is_grad_enabled() or _get_current_dispatch_mode() is not None
        if watched or x.dtype != torch.float32 or isinstance(self.driver, StochasticDriver):
            return None
        if not 0 < len(x) <= FILLED_ROWS[-1] or not is_recordable(world, self.driver):
            return None
        ticks = self._find(world)
        return None if ticks is None else ticks.play(x)

    def _find(self, world: World) -> _WorldTicks | None:
        """Return the ticks of a recordable world that was simulated before."""
        with _ONE_AT_A_TIME:
            for place, known in enumerate(self._known):
                if known.world is world or known.world == world:
                    self._known.append(self._known.pop(place))
                    return known
            self._known = [*self._known[1 - MOST_WORLDS :], _WorldTicks(world, self.driver)]
            return None


class _WorldTicks:
    """Ticks of a world and its ego, which may be recorded."""

    def __init__(self, world: World, driver: Driver) -> None:
        self.world, self._driver = world, driver
        self._program: TickProgram | None = TickProgram(self._tick)
        self._form: Any = None
        """Episodes, their vehicles and the driver's memory, with any tensors in them."""

    def play(self, x: Tensor) -> Episode | None:
        """Return the episodes of scenarios x (B, d) at the horizon; None where they cannot be recorded."""
        program, rows = self._program, len(x)
        if program is None:
            return None
        episode = self.world.start(x)
        tree = episode, episode.state.vehicles, None
        self._form = map_tensors(lambda _: _ANY, tree)
        values = tuple(each.numpy() for each in _tensors_of(tree))
        try:
            with np.errstate(all="ignore"):  # as torch
                for _ in range(self.world.clock.ticks):
                    values = program.run(rows, *values) or self._record(program, values)
        except NotRecorded:
            self._program = None
            return None
        return self._join(map(torch.from_numpy, values))[0]

    def _record(self, program: TickProgram, values: tuple[NDArray[Any], ...]) -> tuple[NDArray[Any], ...]:
        """Record the way of some values, and return them after the tick."""
        with _ONE_AT_A_TIME:
            program.record(*values)
        after = program.run(len(values[0]), *values)
        if after is None:
            raise NotRecorded("the same values go another way")
        return after

    def _tick(self, *values: Tensor) -> list[Tensor]:
        """Return the tensors of the episodes one tick later.

        Raises:
            ValueError: What is not a tensor changes, as a number of the tick would.
        """
        episode, memory = drive_tick(self.world, self._driver, *self._join(values))
        after = (episode, episode.state.vehicles, memory)
        if map_tensors(lambda _: ..., after) != map_tensors(lambda _: ..., self._form):
            raise ValueError("what is not a tensor changes")
        return _tensors_of(after)

    def _join(self, values: Iterable[Tensor]) -> tuple[Episode, Any]:
        """Return the episodes of some tensors and the driver's memory."""
        rest = iter(values)
        episode, vehicles, memory = map_tensors(lambda _: next(rest), self._form)
        return episode._replace(state=episode.state.with_columns(vehicles)), memory


def _tensors_of(tree: Any) -> list[Tensor]:
    """Return the tensors of a tree in their order."""
    found: list[Tensor] = []

    def take(tensor: Tensor) -> None:
        found.append(tensor)

    map_tensors(take, tree)
    return found
