"""Checks of an ego: spaces, normalisation, actions, determinism, memory, independent rows, latency, a few drives.

Each check is a function from a `Probe` to findings; `EGO_CHECKS` lists all of them.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces

from agents.saved_ego import SavedEgo
from rare_envs.devices import CAMERA_TILE
from rare_envs.distributions.coordinates import AnyArray
from rare_envs.egos.policy import PolicyDriver
from rare_envs.egos.wrappers import find_frame_stacking
from rare_envs.plugins import reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.simulation.observation import batch_size, map_kinds, observe
from rare_envs.simulation.world import drive
from rare_envs.study.ego_check import FAIL, HINT, Finding, judge, report_failure, report_pass, report_warning
from samplers.evaluate import Evaluator

BATCH_ROWS = 32
"""Observations in a query."""


@dataclass(frozen=True)
class Probe:
    """An ego in its environment, and observations to query it with."""

    ego: Any
    problem: DrivingProblem
    seen: Any
    """Observations of ordinary scenarios at time 0, shape (ROWS, ...), or several of that kind by name."""

    @classmethod
    def of(cls, ego: Any, problem: DrivingProblem) -> Probe:
        """Return a probe with observations of ordinary scenarios at time 0."""
        x = problem.base.sample(BATCH_ROWS, np.random.default_rng(0))
        with torch.inference_mode():
            start = next(drive(problem.world, problem.driver, torch.from_numpy(x).float()))
            seen = map_kinds(torch.Tensor.numpy, observe(start, problem.world.sensing.observation))
        return cls(ego, problem, seen)

    @property
    def space(self) -> spaces.Space[Any]:
        """Space of the environment's observations."""
        return self.problem.world.observation_space

    def transform_seen(self, change: Callable[[AnyArray], Any]) -> Any:
        """Return the observations after a function, each of its own type."""
        return map_kinds(lambda part: np.asarray(change(part)).astype(part.dtype), self.seen)

    def repeat_seen(self, size: int) -> Any:
        """Return as many observations as `size`, repeating those that there are."""
        return self.transform_seen(lambda part: np.resize(part, (size, *part.shape[1:])))

    @property
    def policy(self) -> Any:
        """Policy of the ego with the wrappers of its training; None if the ego is a driver."""
        return self.problem.driver.policy if isinstance(self.problem.driver, PolicyDriver) else None

    def query(self, observation: Any, state: Any = None, start: Any = None) -> tuple[AnyArray, Any]:
        """Return the actions as numbers, and the memory."""
        begun = np.full(batch_size(observation), state is None) if start is None else start
        action, state = self.policy.predict(
            map_kinds(np.copy, observation), state=state, episode_start=begun, deterministic=True
        )
        return np.asarray(action), state


def largest_difference(one: AnyArray, other: AnyArray) -> float:
    """Return the largest difference of actions; infinite where shapes or NaN differ."""
    if one.shape != other.shape:
        return np.inf
    apart = np.abs(one.astype(float) - other.astype(float))
    apart[np.isnan(one.astype(float)) & np.isnan(other.astype(float))] = 0.0
    return float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))


OUTLYING = 5.0
"""Standard deviations of the training; observations beyond are unlike those that the ego was trained on."""
MANY_OUTLYING = 0.2
"""Share of ordinary scenarios with such observations from which the statistics are most likely of another ego."""


def check_declared_spaces(probe: Probe) -> Iterator[Finding]:
    """Compare declared spaces with the environment's; that they fit at all was found when the problem was made."""
    ours, ours_to_act = probe.space, probe.problem.world.action_space
    # the ego is the user's: it need not declare anything
    observed, acted = declared = [getattr(probe.ego, f"{name}_space", None) for name in ("observation", "action")]
    missing = [name for name, space in zip(("observation", "action"), declared, strict=True) if space is None]
    if missing:
        found = f"it has no {' and '.join(f'{name}_space' for name in missing)}"
        yield report_warning("spaces", found, "taken at its word; declare them, so that a mix-up is noticed", False)
    if observed is not None:
        frames, _ = find_frame_stacking(ours, observed) or (1, False)
        stacked = f", {frames} frames of {ours.shape or ours}" if frames > 1 else ""
        words = f"{observed.shape} {observed.dtype}" if observed.shape is not None else str(observed)
        yield report_pass("observations", f"{words}{stacked}")
        kinds = [space.dtype is not None and np.issubdtype(space.dtype, np.floating) for space in (observed, ours)]
        if observed.dtype is not None and kinds[0] != kinds[1]:
            found = f"it was made for {observed.dtype}, here they are {ours.dtype}"
            yield report_warning("observations", found, "train it on these")
    if isinstance(acted, spaces.Box) and isinstance(ours_to_act, spaces.Box):
        same = np.array_equal(acted.low, ours_to_act.low) and np.array_equal(acted.high, ours_to_act.high)
        unbounded = not (np.isfinite(acted.low).any() or np.isfinite(acted.high).any())
        yield judge(
            "action space",
            not (same or unbounded)
            and f"from {acted.low.tolist()} to {acted.high.tolist()}, the environment's from -1 to 1",
            "in [-1, 1]" if same else "unbounded; clipped to [-1, 1]",
            "they are rescaled, as behind RescaleAction; if its units differ, put a function of yours around it",
        )
    elif acted is not None:
        yield report_pass("action space", str(acted))


def check_normalisation(probe: Probe) -> Iterator[Finding]:
    """Check whether the VecNormalize statistics of a saved ego suit the observations here."""
    if not isinstance(probe.ego, SavedEgo):
        return
    name, statistics, path = "normalisation", probe.ego.statistics, probe.ego.statistics_path
    missing = probe.ego.find_missing_statistics(probe.space)
    if missing:
        yield report_warning(name, f"no VecNormalize statistics, but {missing}", "name their file with --stats")
    elif statistics is None:
        advice = "if it was trained behind VecNormalize, put vecnormalize.pkl there, or name it with --stats"
        yield Finding(name, "pass", "no VecNormalize statistics beside the file", advice)
    elif not statistics.norm_obs:
        yield report_pass(name, f"{path} does not normalise observations")
    elif isinstance(probe.seen, dict) or probe.seen.ndim > 2:
        yield report_pass(name, f"{path}; of such observations their fit is not checked")
    else:
        size = statistics.observation_space.shape[0]
        seen = np.repeat(probe.seen, size // probe.seen.shape[1], 1)  # frames of a stack are alike at time 0
        beyond = float((np.abs(statistics.normalize_obs(seen)) > OUTLYING).any(axis=1).mean())
        result = f"{path}: {beyond:.0%} of ordinary scenarios are over {OUTLYING:g} standard deviations off"
        advice = "are these the statistics of this policy, and of this environment?"
        yield judge(name, beyond > MANY_OUTLYING and result, result, advice)


def check_actions(probe: Probe) -> Iterator[Finding]:
    """Check shape, type and range of actions on ordinary observations."""
    action, _ = probe.query(probe.seen)
    declared = getattr(probe.ego, "action_space", None)  # likewise
    whole = np.issubdtype(action.dtype, np.integer)
    what, shape = f"{action.dtype} of shape {action.shape}", (BATCH_ROWS,) if whole else (BATCH_ROWS, 2)
    if action.shape != shape or action.dtype == object:
        yield report_failure("actions", what, f"return shape {(BATCH_ROWS, 2)}, or {BATCH_ROWS} whole numbers")
        return
    n_bad = int((~np.isfinite(action).reshape(BATCH_ROWS, -1).all(axis=1)).sum())
    if n_bad:
        bad = f"NaN or infinite for {n_bad} of {BATCH_ROWS} observations"
        yield report_failure("actions", bad, "check weights and normalisation")
        return
    if declared is not None and isinstance(declared, spaces.Discrete) != whole:
        yield report_failure("actions", f"{what}, but it says {declared}", "make both agree")
        return
    beyond = 0.0 if whole else float((np.abs(action) > 1.0 + 1e-6).mean())
    if beyond:
        far = f"{beyond:.0%} beyond [-1, 1], up to {np.abs(action).max():.3g}"
        yield report_warning("actions", far, "they are clipped", False)
    same = len(np.unique(action.round(6), axis=0)) == 1
    yield judge(
        "actions",
        same and f"the same for all {BATCH_ROWS} observations: {action[0].tolist()}",
        f"{action.dtype} of shape (B{', 2' if not whole else ''}), finite",
        "does it look at all?",
    )


def check_extreme_observations(probe: Probe) -> Iterator[Finding]:
    """Query the ego with zeros (rows whose episode is over), with the bounds of its observations, and with NaN."""
    space = probe.space
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    cases = {
        "zeros": probe.transform_seen(np.zeros_like),
        "the lower end": map_kinds(lambda part, box: _fill_with_bound(box.low, -1.0, part), probe.seen, boxes),
        "the upper end": map_kinds(lambda part, box: _fill_with_bound(box.high, 1.0, part), probe.seen, boxes),
    }
    bad = []
    for name, case in cases.items():
        try:
            action, _ = probe.query(case)
            bad += [] if np.isfinite(action).all() else [f"{name}: NaN or infinite"]
        except (Exception, SystemExit) as error:
            bad.append(f"{name}: {reason_of(error)}")
    advice = "such observations come; rows are zeros after a crash"
    yield judge("range", "; ".join(bad), "finite at zeros and at both ends of what is observed", advice, FAIL)
    if not isinstance(probe.seen, dict) and probe.seen.dtype == np.uint8:
        return
    try:
        action, _ = probe.query(map_kinds(lambda part: part if part.dtype == np.uint8 else part * np.nan, probe.seen))
        numbers = "answered by numbers; the environment never gives NaN"
        yield report_pass("NaN", numbers if np.isfinite(action).all() else "answered by NaN")
    except (Exception, SystemExit) as error:
        yield report_pass("NaN", f"refused: {reason_of(error)}")


def _fill_with_bound(bound: AnyArray, unbounded: float, part: AnyArray) -> AnyArray:
    """Return observations at a bound of their space, or at `unbounded` where it has none."""
    return np.broadcast_to(np.where(np.isfinite(bound), bound, unbounded), part.shape).astype(part.dtype)


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
    third, off = probe.query(probe.seen)[0], largest_difference(first, second)
    if off:
        found = f"its answers vary from call to call, by up to {off:.2g}"
        advice = "random, or a memory not in its state; p is then over this too, and failures may not replay"
        yield report_warning("determinism", found, advice)
        return
    yield judge(
        "determinism",
        largest_difference(first, third) > 0.0 and "its answers depend on earlier calls",
        "the same answer to the same observations",
        "carry its memory in the state that predict returns: batches of many scenarios take turns",
        FAIL,
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
    yield judge(
        "memory",
        off > ACTION_ROUNDING and f"kept in its state, but rows that begin an episode are off by {off:.2g}",
        "kept in its state, reset where an episode begins",
        "reset the rows of episode_start; here whole batches begin together, so this may not matter",
        HINT,
    )


def check_row_independence(probe: Probe) -> Iterator[Finding]:
    """Check whether a row's answer depends on the other rows, their order or their number."""
    whole = probe.query(probe.seen)[0]
    order = np.random.default_rng(1).permutation(BATCH_ROWS)
    shuffled = largest_difference(probe.query(probe.transform_seen(lambda part: part[order]))[0], whole[order])
    single = [probe.transform_seen(lambda part, row=row: part[row : row + 1]) for row in range(8)]  # type: ignore[misc]
    alone = largest_difference(np.concatenate([probe.query(row)[0] for row in single]), whole[:8])
    for name, off in (("order of the batch", shuffled), ("size of the batch", alone)):
        bad = off > ACTION_ROUNDING and f"actions change with it, by up to {off:.2g}"
        good = "no effect" if off == 0.0 else f"rounding, {off:.1g}"
        yield judge(name, bad, good, "a row must not depend on the others; is a batch norm in training mode?", FAIL)


def check_latency(probe: Probe) -> Iterator[Finding]:
    """Measure the duration of a call by batch size."""
    times = {}
    sizes = CAMERA_BATCH_SIZES if "camera" in probe.problem.world.sensing.kinds else BATCH_SIZES
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
    slow = f"{calls}: {needed / 3600:.1f} h for {TYPICAL_SIMULATIONS} simulations"
    good = f"{calls}: {needed:.0f} s for {TYPICAL_SIMULATIONS} simulations"
    yield judge("latency", needed > SLOW_SECONDS and slow, good, "batch its work", HINT)


def check_memory_growth(probe: Probe) -> Iterator[Finding]:
    """Measure by how much the process grows over 100 calls."""
    pictures = "camera" in probe.problem.world.sensing.kinds
    observation = probe.repeat_seen(4 if pictures else 256)
    for _ in range(20):
        probe.query(observation)
    before = _read_megabytes()
    for _ in range(100):
        probe.query(observation)
    grown = _read_megabytes() - before
    bad = grown > LEAK_MEGABYTES and f"{grown:.0f} MB more after 100 calls"
    good = f"{before:.0f} MB in all, {max(grown, 0.0):.0f} MB more after 100 calls"
    yield judge("space", bad, good, "it keeps what it has seen; a long run ends early", HINT)


def check_driving(probe: Probe) -> Iterator[Finding]:
    """Drive a few ordinary scenarios."""
    evaluator = Evaluator(probe.problem, on_error="failure")
    f = evaluator.evaluate(probe.problem.base.sample(BATCH_ROWS, np.random.default_rng(2)))
    if evaluator.faults:
        failed = f"fails on {len(evaluator.faults)} of {BATCH_ROWS} ordinary scenarios: {evaluator.faults[0].reason}"
        advice = "mend it, or count such scenarios with --on-error failure or bound"
        yield report_failure("driving", failed, advice)
        return
    crashed = float((f == -1.0).mean())
    result = f"collides in {crashed:.0%} of {BATCH_ROWS} ordinary scenarios"
    advice = "does it see and act as in its training? is it trained?"
    yield judge("driving", crashed > MANY_COLLISIONS and result, result, advice)


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
