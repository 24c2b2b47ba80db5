"""Checks of an ego's behaviour: determinism, memory, independent rows, latency, and a few drives.

Each check is a function from a `Probe` to findings; `EGO_CHECKS` lists all of them, those of the interface included.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

from rare_envs.devices.batch_sizes import CAMERA_TILE
from rare_envs.egos.faults import FaultTolerant
from rare_envs.sensors.kinds import kinds_of
from rare_envs.study.ego_check.findings import Finding, report_failure, report_pass, report_warning
from rare_envs.study.ego_check.interface import (
    check_actions,
    check_declared_spaces,
    check_extreme_observations,
    check_normalisation,
)
from rare_envs.study.ego_check.probe import BATCH_ROWS, Probe, largest_difference

ACTION_ROUNDING = 1e-3
"""Differences of actions above this are not rounding."""
BATCH_SIZES = (1, 64, 1024)
"""Batch sizes at which latency is measured."""
CAMERA_BATCH_SIZES = (1, 16, CAMERA_TILE)
"""The same for an ego with a camera, which never gets a larger batch."""
TYPICAL_SIMULATIONS = 6000
"""Simulations of a usual estimation, to express latency as its duration."""
SLOW_SECONDS = 3600.0
"""Duration of such an estimation [s] from which latency is worth a warning."""
LEAK_MEGABYTES = 64.0
"""Growth of the process over 100 calls [MB] from which it is worth a warning."""
MANY_COLLISIONS = 0.5
"""Share of ordinary scenarios: an ego that collides in more has most likely been given wrong inputs."""


def check_determinism(probe: Probe) -> Iterator[Finding]:
    """Check whether an answer repeats, and whether it depends on earlier calls."""
    other = probe.transform_seen(lambda part: np.roll(part, 1, axis=0) * 0.5)
    first, second = probe.query(probe.seen)[0], probe.query(probe.seen)[0]
    probe.query(other)
    third = probe.query(probe.seen)[0]
    if largest_difference(first, second) == 0.0 and largest_difference(first, third) == 0.0:
        yield report_pass("determinism", "the same answer to the same observations")
    elif largest_difference(first, second) == 0.0:
        yield report_failure(
            "determinism",
            "its answers depend on earlier calls",
            "carry its memory in the state that predict returns: batches of many scenarios take turns",
        )
    else:
        yield report_warning(
            "determinism",
            f"its answers vary from call to call, by up to {largest_difference(first, second):.2g}",
            "random, or a memory not in its state; p is then over this too, and failures may not replay",
        )


def check_memory(probe: Probe) -> Iterator[Finding]:
    """Check whether the ego has a memory, and whether it is reset where an episode begins."""
    first, state = probe.query(probe.seen)
    if state is None:
        yield report_pass("memory", "none: an answer depends on one observation")
        return
    for _ in range(2):
        _, state = probe.query(probe.transform_seen(lambda part: part * 0.9), state)
    begun = np.zeros(BATCH_ROWS, dtype=bool)
    begun[: BATCH_ROWS // 2] = True
    again, _ = probe.query(probe.seen, state, begun)
    off = largest_difference(first[begun], again[begun])
    if off > ACTION_ROUNDING:
        yield report_warning(
            "memory",
            f"kept in its state, but rows that begin an episode are off by {off:.2g}",
            "reset the rows of episode_start; here whole batches begin together, so this may not matter",
            False,
        )
    else:
        yield report_pass("memory", "kept in its state, reset where an episode begins")


def check_row_independence(probe: Probe) -> Iterator[Finding]:
    """Check whether a row's answer depends on the other rows, their order or their number."""
    whole = probe.query(probe.seen)[0]
    order = np.random.default_rng(1).permutation(BATCH_ROWS)
    shuffled = largest_difference(probe.query(probe.transform_seen(lambda part: part[order]))[0], whole[order])
    single = [probe.transform_seen(lambda part, row=row: part[row : row + 1]) for row in range(8)]  # type: ignore[misc]
    alone = largest_difference(np.concatenate([probe.query(row)[0] for row in single]), whole[:8])
    for name, off in (("order of the batch", shuffled), ("size of the batch", alone)):
        if off > ACTION_ROUNDING:
            yield report_failure(
                name,
                f"actions change with it, by up to {off:.2g}",
                "a row must not depend on the others; is a batch norm in training mode?",
            )
        else:
            yield report_pass(name, "no effect" if off == 0.0 else f"rounding, {off:.1g}")


def check_latency(probe: Probe) -> Iterator[Finding]:
    """Measure the duration of a call by batch size."""
    times = {}
    sizes = CAMERA_BATCH_SIZES if "camera" in kinds_of(probe.problem.world.sensing.observation) else BATCH_SIZES
    for size in sizes:
        observation = probe.repeat_seen(size)
        probe.query(observation)
        durations = []
        for _ in range(5 if size < sizes[-1] else 3):
            begun = time.perf_counter()
            probe.query(observation)
            durations.append(time.perf_counter() - begun)
        times[size] = float(np.median(durations))
    calls = ", ".join(f"{1e3 * seconds:.2g} ms for {size}" for size, seconds in times.items())
    needed = TYPICAL_SIMULATIONS / sizes[-1] * times[sizes[-1]] * probe.problem.world.clock.ticks
    if needed > SLOW_SECONDS:
        yield report_warning(
            "latency", f"{calls}: {needed / 3600:.1f} h for {TYPICAL_SIMULATIONS} simulations", "batch its work", False
        )
    else:
        yield report_pass("latency", f"{calls}: {needed:.0f} s for {TYPICAL_SIMULATIONS} simulations")


def check_memory_growth(probe: Probe) -> Iterator[Finding]:
    """Measure by how much the process grows over 100 calls."""
    pictures = "camera" in kinds_of(probe.problem.world.sensing.observation)
    observation = probe.repeat_seen(4 if pictures else 256)
    for _ in range(20):
        probe.query(observation)
    before = _read_megabytes()
    for _ in range(100):
        probe.query(observation)
    grown = _read_megabytes() - before
    if grown > LEAK_MEGABYTES:
        yield report_warning(
            "space",
            f"{grown:.0f} MB more after 100 calls",
            "it keeps what it has seen; a long run ends early",
            False,
        )
    else:
        yield report_pass("space", f"{before:.0f} MB in all, {max(grown, 0.0):.0f} MB more after 100 calls")


def check_driving(probe: Probe) -> Iterator[Finding]:
    """Drive a few ordinary scenarios."""
    tolerant = FaultTolerant(probe.problem)
    f = tolerant.evaluate(probe.problem.base.sample(BATCH_ROWS, np.random.default_rng(2)))
    if tolerant.faults:
        yield report_failure(
            "driving",
            f"fails on {len(tolerant.faults)} of {BATCH_ROWS} ordinary scenarios: {tolerant.faults[0].reason}",
            "mend it, or count such scenarios with --on-error failure or bound",
        )
        return
    crashed = float((f == -1.0).mean())
    result = f"collides in {crashed:.0%} of {BATCH_ROWS} ordinary scenarios"
    if crashed > MANY_COLLISIONS:
        yield report_warning("driving", result, "does it see and act as in its training? is it trained?")
    else:
        yield report_pass("driving", result)


EGO_CHECKS: tuple[Callable[[Probe], Iterator[Finding]], ...] = (
    check_declared_spaces,
    check_normalisation,
    check_actions,
    check_determinism,
    check_memory,
    check_row_independence,
    check_extreme_observations,
    check_driving,
    check_latency,
    check_memory_growth,
)


def _read_megabytes() -> float:
    """Return the memory of this process [MB]: the present use where the system reports it, else the peak."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20
    except OSError:
        try:
            import resource
        except ImportError:  # Windows, where the standard library does not tell
            return 0.0
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
