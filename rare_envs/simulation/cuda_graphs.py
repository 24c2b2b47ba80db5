"""RecordedRollouts: rollouts on a GPU, recorded as CUDA graphs when they are first made and played from then on.

A rollout is some thousands of small operations, and to start each from Python takes five to ten times as long as the
GPU takes for all of them, at 1,024 rollouts.
"""

from __future__ import annotations

import threading
from types import MethodType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rare_envs.measures import MEASURES
from rare_envs.measures.registry import PAIR_CLEARANCE, TermTracker
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import Driver, World, rollout
from rare_envs.traffic.state import map_tensors

STEPS = 4
"""Numbers of rollouts that are recorded: a tile, a quarter of it, and so on; fewer rollouts are filled up."""
MOST_RECORDINGS = 12
"""Kept at once, with the memory of their operations; what was not played for longest goes first."""
_ONE_AT_A_TIME = threading.Lock()
"""Threads would write their scenarios to the same place, or record each other's operations."""


class Recording(NamedTuple):
    """A rollout of a fixed number of scenarios, from numbers in one place to numbers in others."""

    world: World
    x: Tensor
    """Where it reads scenarios, shape (size, d)."""
    graph: Any
    """The CUDA graph; None if the record broke off, because an operation waits for the GPU, as those of a camera."""
    end: Episode | None = None
    """Where it writes the episodes at the horizon."""


class RecordedRollouts:
    """Rollouts of a driver on a GPU: as `rollout`, but for what the processor takes to start the operations.

    What cannot be recorded is made by `rollout` itself, see `is_recordable`. `sizes` are the numbers of rollouts that
    are recorded, ascending.
    """

    def __init__(self, driver: Driver, tile: int) -> None:
        """Record nothing yet of a driver, on the GPU, and of a tile, the most rollouts at once."""
        self.driver = driver
        self.sizes = tuple(sorted({max(1, tile // 4**step) for step in range(STEPS)}))
        self._recordings: list[Recording] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process can take over: all but the recordings."""
        return vars(self) | {"_recordings": []}

    def __call__(self, world: World, x: Tensor) -> Episode:
        """Return the episodes of scenarios x (B, d), B at most a tile, at the horizon, as `rollout` does."""
        batch = len(x)
        if x.device.type != "cuda" or not batch:
            return rollout(world, self.driver, x)
        with torch.cuda.device(x.device):  # else one of several GPUs would be recorded on the first
            with _ONE_AT_A_TIME:
                found = self._find(world, x)
                if found is not None and found.end is not None:
                    found.x[:batch] = x
                    found.x[batch:] = x[0]  # scenarios that nobody asks for; any do
                    found.graph.replay()
                    return Episode(*map_tensors(lambda part: part[:batch].clone(), found.end))
            return rollout(world, self.driver, x)

    def _find(self, world: World, x: Tensor) -> Recording | None:
        """Return the recording that x fits, made if need be; None if there cannot be one."""
        size = next((size for size in self.sizes if size >= len(x)), None)
        if size is None or not is_recordable(world, self.driver):
            return None
        for place, known in enumerate(self._recordings):
            if known.world == world and (known.graph is None or known.x.shape == (size, x.shape[1])):
                self._recordings.append(self._recordings.pop(place))
                return known
        try:
            recording = record(world, self.driver, x, size)
        except torch.OutOfMemoryError:  # recordings keep their memory
            self._recordings = []
            torch.cuda.empty_cache()
            recording = record(world, self.driver, x, size)
        self._recordings = [*self._recordings[1 - MOST_RECORDINGS :], recording]
        return recording


def record(world: World, driver: Driver, x: Tensor, size: int) -> Recording:
    """Return the record of a rollout of `size` scenarios like x (B, d) on the GPU."""
    place = x[0].expand(size, -1).clone()
    aside = torch.cuda.Stream(x.device)  # type: ignore[no-untyped-call]
    aside.wait_stream(torch.cuda.current_stream(x.device))
    with torch.cuda.stream(aside):  # makes constants, and what libraries make at their first call
        rollout(world, driver, place)
    torch.cuda.current_stream(x.device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    try:
        with torch.cuda.graph(graph, stream=aside, capture_error_mode="thread_local"):  # torch's own is of one GPU
            end = rollout(world, driver, place)
    except torch.OutOfMemoryError:
        raise
    except (RuntimeError, TypeError):  # an operation that waits for the GPU, or leaves it
        torch.cuda.synchronize(x.device)
        return Recording(world, place, None)
    return Recording(world, place, graph, end)


def is_recordable(world: World, driver: Driver) -> bool:
    """Return whether nothing about a rollout but x can change: as drivers' classes say, for nothing of a user's."""
    drivers = (driver,) if world.background is None else (driver, world.background)
    scenario = world.scenario
    scripts = (scenario.initial, scenario.others, scenario.driven, scenario.signals, scenario.evades)
    owners = [type(script.__self__) for script in scripts if isinstance(script, MethodType)]
    own = (str(getattr(each, "__module__", "")).startswith("rare_envs.") for each in (*scripts, *owners) if each)
    measure = world.measurement.episode_measure
    read = (measure.measure, measure.order) if isinstance(measure, TermTracker) else (measure,)
    known = (PAIR_CLEARANCE, *MEASURES.values())
    return all(map(says_recordable, drivers)) and all(own) and all(any(m is k for k in known) for m in read)


def says_recordable(driver: Any) -> bool:
    """Return whether a driver's own class says that it never changes; what it says is not inherited."""
    return "recordable" in vars(type(driver)) and bool(driver.recordable)
