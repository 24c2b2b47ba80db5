"""RecordedRollouts: rollouts on a GPU, recorded as CUDA graphs when they are first made and played from then on.

A rollout is some thousands of small operations, and to start each from Python takes five to ten times as long as the
GPU takes for all of them, at 1,024 rollouts.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

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
_OWN = "rare_envs."
_ONE_AT_A_TIME = threading.Lock()
"""Threads would write their scenarios to the same place, or record each other's operations."""


class RecordedRollouts:
    """Rollouts of a driver on a GPU: as `rollout`, but for what the processor takes to start the operations.

    What cannot be recorded is made by `rollout` itself: for users' drivers and measures see `is_recordable`, and where
    an operation has to wait for the GPU, as those of a camera, the record breaks off. `sizes` are the numbers of
    rollouts that are recorded, ascending.
    """

    def __init__(self, driver: Driver, tile: int) -> None:
        """Record nothing yet of a driver, on the GPU, and of a tile, the most rollouts at once."""
        self.driver = driver
        self.sizes = tuple(sorted({max(1, tile // 4**step) for step in range(STEPS)}))
        self._recordings: list[_Recording] = []
        self._unrecordable: list[World] = []
        """Of which the record broke off."""

    def __getstate__(self) -> dict[str, Any]:
        """Return what another process can take over: all but the recordings."""
        return vars(self) | {"_recordings": []}

    def __call__(self, world: World, x: Tensor) -> Episode:
        """Return the episodes of scenarios x (B, d), B at most a tile, at the horizon, as `rollout` does."""
        if x.device.type != "cuda" or not len(x):
            return rollout(world, self.driver, x)
        with torch.cuda.device(x.device):  # else one of several GPUs would be recorded on the first
            with _ONE_AT_A_TIME:
                recording = self._find(world, x)
                if recording is not None:
                    return recording.play(x)
            return rollout(world, self.driver, x)

    def _find(self, world: World, x: Tensor) -> _Recording | None:
        """Return the recording that x fits, made if need be; None where there cannot be one."""
        size = next((size for size in self.sizes if size >= len(x)), None)
        if size is None or not is_recordable(world, self.driver) or world in self._unrecordable:
            return None
        for place, known in enumerate(self._recordings):
            if known.x.shape == (size, x.shape[1]) and known.world == world:
                self._recordings.append(self._recordings.pop(place))
                return known
        try:
            recording = record(world, self.driver, x, size)
        except torch.OutOfMemoryError:  # recordings keep their memory
            self._recordings = []
            torch.cuda.empty_cache()
            recording = record(world, self.driver, x, size)
        if recording is None:
            self._unrecordable.append(world)
            return None
        self._recordings = [*self._recordings[1 - MOST_RECORDINGS :], recording]
        return recording


@dataclass(frozen=True, eq=False)
class _Recording:
    """A rollout of a fixed number of scenarios, from numbers in one place to numbers in others."""

    world: World
    x: Tensor
    """Where it reads scenarios, shape (size, d)."""
    graph: torch.cuda.CUDAGraph
    end: Episode
    """Where it writes the episodes at the horizon."""

    def play(self, x: Tensor) -> Episode:
        """Return the episodes of scenarios x (B, d), B at most the size of the recording, at the horizon."""
        batch = len(x)
        self.x[:batch] = x
        self.x[batch:] = x[0]  # scenarios that nobody asks for; any do
        self.graph.replay()
        return Episode(*map_tensors(lambda part: part[:batch].clone(), self.end))


def record(world: World, driver: Driver, x: Tensor, size: int) -> _Recording | None:
    """Return the record of a rollout of `size` scenarios like x (B, d) on the GPU; None where there cannot be one."""
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
        return None
    return _Recording(world, place, graph, end)


def is_recordable(world: World, driver: Driver) -> bool:
    """Return whether a rollout may be recorded once and played with other x.

    What a recording does is fixed, as are the numbers in it. So it is for drivers whose own class says that they never
    change (`says_recordable`), for scenarios and measures of this package, not for what a user wrote.
    """
    drivers = (driver,) if world.background is None else (driver, world.background)
    steady = all(says_recordable(each) for each in drivers)
    scripts = (world.scenario.initial, world.scenario.others, world.scenario.driven)
    own = all(script is None or str(getattr(script, "__module__", "")).startswith(_OWN) for script in scripts)
    return steady and own and _is_known(world.measurement.episode_measure)


def says_recordable(driver: Any) -> bool:
    """Return whether a driver's own class says that it never changes; what it says is not inherited."""
    return "recordable" in vars(type(driver)) and bool(driver.recordable)


def _is_known(measure: Any) -> bool:
    """Return whether a measure is one of this package's, or tells the terms of one apart."""
    if isinstance(measure, TermTracker):
        return _is_known(measure.measure) and _is_known(measure.order)
    return measure is PAIR_CLEARANCE or any(measure is known for known in MEASURES.values())
