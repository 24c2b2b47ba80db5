"""Checks of an ego in an environment, one function each; `rare_envs.study.ego_check.subprocess_check` runs them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator

import numpy as np

from rare_envs.egos.faults import FaultTolerant
from rare_envs.problem import CAMERA_TILE
from rare_envs.sensors.kinds import kinds_of
from rare_envs.study.ego_check.findings import Finding, failed, passed, warned
from rare_envs.study.ego_check.interface import acts, at_the_edges, spaces_fit, statistics_fit
from rare_envs.study.ego_check.probe import ROWS, Probe, differ

ROUNDING = 1e-3
"""Differences of actions above this are no rounding."""
SIZES = (1, 64, 1024)
PICTURES = (1, 16, CAMERA_TILE)
"""Likewise of an ego that sees, which is never shown more at once."""
TYPICAL = 6000
"""Simulations of an estimation, for what latency means."""
SLOW = 3600.0
"""Seconds of such an estimation from which latency is worth a warning."""
LEAK = 64.0
"""MB over 100 calls."""


def same_again(probe: Probe) -> Iterator[Finding]:
    """Whether an answer repeats, and whether it depends on what was asked before."""
    other = probe.changed(lambda part: np.roll(part, 1, axis=0) * 0.5)
    first, second = probe.ask(probe.seen)[0], probe.ask(probe.seen)[0]
    probe.ask(other)
    third = probe.ask(probe.seen)[0]
    if differ(first, second) == 0.0 and differ(first, third) == 0.0:
        yield passed("determinism", "the same answer to the same observations")
    elif differ(first, second) == 0.0:
        yield failed(
            "determinism",
            "its answers depend on earlier calls",
            "carry its memory in the state that predict returns: batches of many scenarios take turns",
        )
    else:
        yield warned(
            "determinism",
            f"its answers vary from call to call, by up to {differ(first, second):.2g}",
            "random, or a memory not in its state; p is then over this too, and failures may not replay",
        )


def remembers(probe: Probe) -> Iterator[Finding]:
    """Whether it has a memory, and begins anew where an episode does."""
    first, state = probe.ask(probe.seen)
    if state is None:
        yield passed("memory", "none: an answer depends on one observation")
        return
    for _ in range(2):
        _, state = probe.ask(probe.changed(lambda part: part * 0.9), state)
    begun = np.zeros(ROWS, dtype=bool)
    begun[: ROWS // 2] = True
    again, _ = probe.ask(probe.seen, state, begun)
    off = differ(first[begun], again[begun])
    if off > ROUNDING:
        yield warned(
            "memory",
            f"kept in its state, but rows that begin an episode are off by {off:.2g}",
            "reset the rows of episode_start; here whole batches begin together, so this may not matter",
            False,
        )
    else:
        yield passed("memory", "kept in its state, reset where an episode begins")


def rows_stand_alone(probe: Probe) -> Iterator[Finding]:
    """Whether a row's answer depends on the other rows, their order or their number."""
    whole = probe.ask(probe.seen)[0]
    order = np.random.default_rng(1).permutation(ROWS)
    shuffled = differ(probe.ask(probe.changed(lambda part: part[order]))[0], whole[order])
    single = [probe.changed(lambda part, row=row: part[row : row + 1]) for row in range(8)]  # type: ignore[misc]
    alone = differ(np.concatenate([probe.ask(row)[0] for row in single]), whole[:8])
    for name, off in (("order of the batch", shuffled), ("size of the batch", alone)):
        if off > ROUNDING:
            yield failed(
                name,
                f"actions change with it, by up to {off:.2g}",
                "a row must not depend on the others; is a batch norm in training mode?",
            )
        else:
            yield passed(name, "no effect" if off == 0.0 else f"rounding, {off:.1g}")


def is_fast(probe: Probe) -> Iterator[Finding]:
    """Milliseconds by batch size."""
    times = {}
    sizes = PICTURES if "camera" in kinds_of(probe.problem.world.observation) else SIZES
    for size in sizes:
        observation = probe.rows(size)
        probe.ask(observation)
        durations = []
        for _ in range(5 if size < sizes[-1] else 3):
            begun = time.perf_counter()
            probe.ask(observation)
            durations.append(time.perf_counter() - begun)
        times[size] = float(np.median(durations))
    found = ", ".join(f"{1e3 * seconds:.2g} ms for {size}" for size, seconds in times.items())
    needed = TYPICAL / sizes[-1] * times[sizes[-1]] * probe.problem.world.ticks
    if needed > SLOW:
        yield warned("latency", f"{found}: {needed / 3600:.1f} h for {TYPICAL} simulations", "batch its work", False)
    else:
        yield passed("latency", f"{found}: {needed:.0f} s for {TYPICAL} simulations")


def keeps_memory_small(probe: Probe) -> Iterator[Finding]:
    """Megabytes that 100 calls leave behind."""
    pictures = "camera" in kinds_of(probe.problem.world.observation)
    observation = probe.rows(4 if pictures else 256)
    for _ in range(20):
        probe.ask(observation)
    before = _megabytes()
    for _ in range(100):
        probe.ask(observation)
    grown = _megabytes() - before
    if grown > LEAK:
        yield warned(
            "space",
            f"{grown:.0f} MB more after 100 calls",
            "it keeps what it has seen; a long run ends early",
            False,
        )
    else:
        yield passed("space", f"{before:.0f} MB in all, {max(grown, 0.0):.0f} MB more after 100 calls")


def drives(probe: Probe) -> Iterator[Finding]:
    """A few ordinary scenarios."""
    tolerant = FaultTolerant(probe.problem)
    f = tolerant.evaluate(probe.problem.base.sample(ROWS, np.random.default_rng(2)))
    if tolerant.faults:
        yield failed(
            "driving",
            f"fails on {len(tolerant.faults)} of {ROWS} ordinary scenarios: {tolerant.faults[0].reason}",
            "mend it, or count such scenarios with --on-error failure or bound",
        )
        return
    crashed = float((f == -1.0).mean())
    found = f"collides in {crashed:.0%} of {ROWS} ordinary scenarios"
    if crashed > 0.5:
        yield warned("driving", found, "does it see and act as in its training? is it trained?")
    else:
        yield passed("driving", found)


CHECKS: tuple[Callable[[Probe], Iterator[Finding]], ...] = (
    spaces_fit,
    statistics_fit,
    acts,
    same_again,
    remembers,
    rows_stand_alone,
    at_the_edges,
    drives,
    is_fast,
    keeps_memory_small,
)


def _megabytes() -> float:
    """Memory of this process: at present where the system tells, else at most."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
