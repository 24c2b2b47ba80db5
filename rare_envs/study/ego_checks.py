"""Checks of an ego in an environment, one function each; `rare_envs.study.check_ego` runs them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray

from rare_envs import DrivingProblem
from rare_envs.actions import space_of_actions
from rare_envs.drivers import PolicyDriver
from rare_envs.faults import FaultTolerant, reason_of
from rare_envs.mixed import batch_size, each, kinds_of
from rare_envs.observation import observe, space_of_observations
from rare_envs.policies import frames_of
from rare_envs.problem import CAMERA_TILE
from rare_envs.rollout import drive
from rare_envs.study.findings import Finding, failed, passed, warned

ROWS = 32
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

Array = NDArray[Any]


@dataclass(frozen=True)
class Probe:
    """An ego in its environment, and observations to ask it about."""

    ego: Any
    problem: DrivingProblem
    seen: Any
    """Observations of ordinary scenarios at time 0, shape (ROWS, ...), or several of that kind by name."""

    @classmethod
    def of(cls, ego: Any, problem: DrivingProblem) -> Probe:
        """Take observations."""
        x = problem.base.sample(ROWS, np.random.default_rng(0))
        with torch.inference_mode():
            start = next(drive(problem.world, problem.driver, torch.from_numpy(x).float()))
            seen = each(torch.Tensor.numpy, observe(start, problem.world.observation))
        return cls(ego, problem, seen)

    @property
    def space(self) -> spaces.Space[Any]:
        """What the environment observes."""
        return space_of_observations(self.problem.world)

    def changed(self, change: Callable[[Array], Any]) -> Any:
        """The observations changed by a function, and of their own types."""
        return each(lambda part: np.asarray(change(part)).astype(part.dtype), self.seen)

    def rows(self, size: int) -> Any:
        """So many observations."""
        return self.changed(lambda part: np.resize(part, (size, *part.shape[1:])))

    @property
    def policy(self) -> Any:
        """The ego behind the wrappers of its training."""
        return self.problem.driver.policy if isinstance(self.problem.driver, PolicyDriver) else None

    def ask(self, observation: Any, state: Any = None, start: Any = None) -> tuple[Array, Any]:
        """Actions as numbers, and the memory."""
        begun = np.full(batch_size(observation), state is None) if start is None else start
        action, state = self.policy.predict(
            each(np.copy, observation), state=state, episode_start=begun, deterministic=True
        )
        return np.asarray(action), state


def spaces_fit(probe: Probe) -> Iterator[Finding]:
    """Declared spaces against the environment's; that they fit at all was found when the problem was made."""
    world = probe.problem.world
    ours = probe.space, space_of_actions(world.action)
    observed, acts = (getattr(probe.ego, f"{name}_space", None) for name in ("observation", "action"))
    if observed is None or acts is None:
        missing = " and ".join(
            name for name, space in (("observation_space", observed), ("action_space", acts)) if space is None
        )
        yield warned(
            "spaces",
            f"it has no {missing}",
            "taken at its word; declare them, so that a mix-up is noticed",
            False,
        )
    if observed is not None:
        frames, _ = frames_of(ours[0], observed) or (1, False)
        stacked = f", {frames} frames of {ours[0].shape or ours[0]}" if frames > 1 else ""
        words = f"{observed.shape} {observed.dtype}" if observed.shape is not None else str(observed)
        yield passed("observations", f"{words}{stacked}")
        if observed.dtype is not None and np.issubdtype(observed.dtype, np.floating) != np.issubdtype(
            ours[0].dtype, np.floating
        ):
            yield warned(
                "observations", f"it was made for {observed.dtype}, here they are {ours[0].dtype}", "train it on these"
            )
    if isinstance(acts, spaces.Box) and isinstance(ours[1], spaces.Box):
        same = np.array_equal(acts.low, ours[1].low) and np.array_equal(acts.high, ours[1].high)
        unbounded = not (np.isfinite(acts.low).any() or np.isfinite(acts.high).any())
        if same or unbounded:
            yield passed("action space", "in [-1, 1]" if same else "unbounded; clipped to [-1, 1]")
        else:
            yield warned(
                "action space",
                f"from {acts.low.tolist()} to {acts.high.tolist()}, the environment's from -1 to 1",
                "they are clipped, not rescaled; if its units differ, put a function of yours around it",
            )
    elif acts is not None:
        yield passed("action space", str(acts))


def statistics_fit(probe: Probe) -> Iterator[Finding]:
    """VecNormalize statistics, and whether they suit what is observed here."""
    if not hasattr(probe.ego, "statistics_path"):
        return
    if probe.ego.statistics is None:
        yield Finding(
            "normalisation",
            "pass",
            "no VecNormalize statistics beside the file",
            "if it was trained behind VecNormalize, put vecnormalize.pkl there",
        )
        return
    statistics = probe.ego.statistics
    if not statistics.norm_obs:
        yield passed("normalisation", f"{probe.ego.statistics_path} does not normalise observations")
        return
    if isinstance(probe.seen, dict) or probe.seen.ndim > 2:
        yield passed("normalisation", f"{probe.ego.statistics_path}; of such observations their fit is not checked")
        return
    single = statistics.observation_space.shape == probe.seen.shape[1:]
    seen = (
        probe.seen if single else np.repeat(probe.seen, statistics.observation_space.shape[0] // probe.seen.shape[1], 1)
    )
    beyond = float((np.abs(statistics.normalize_obs(seen)) > 5.0).any(axis=1).mean())
    found = f"{probe.ego.statistics_path}: {beyond:.0%} of ordinary scenarios are over 5 standard deviations off"
    if beyond > 0.2:
        yield warned("normalisation", found, "are these the statistics of this policy, and of this environment?")
    else:
        yield passed("normalisation", found)


def acts(probe: Probe) -> Iterator[Finding]:
    """Shape, type and range of actions on ordinary observations."""
    action, _ = probe.ask(probe.seen)
    declared = getattr(probe.ego, "action_space", None)
    whole = np.issubdtype(action.dtype, np.integer)
    expected = (ROWS,) if whole else (ROWS, 2)
    if action.shape != expected or action.dtype == object:
        yield failed(
            "actions",
            f"{action.dtype} of shape {action.shape}",
            f"return shape {(ROWS, 2)}, or {ROWS} whole numbers",
        )
        return
    if not np.isfinite(action).all():
        bad = int((~np.isfinite(action)).reshape(ROWS, -1).any(axis=1).sum())
        yield failed("actions", f"NaN or infinite for {bad} of {ROWS} observations", "check weights and normalisation")
        return
    if isinstance(declared, spaces.Discrete) != whole and declared is not None:
        yield failed("actions", f"{action.dtype} of shape {action.shape}, but it says {declared}", "make both agree")
        return
    beyond = 0.0 if whole else float((np.abs(action) > 1.0 + 1e-6).mean())
    if beyond:
        yield warned(
            "actions",
            f"{beyond:.0%} beyond [-1, 1], up to {np.abs(action).max():.3g}",
            "they are clipped",
            False,
        )
    if len(np.unique(action.round(6), axis=0)) == 1:
        yield warned("actions", f"the same for all {ROWS} observations: {action[0].tolist()}", "does it look at all?")
    else:
        yield passed("actions", f"{action.dtype} of shape (B{', 2' if not whole else ''}), finite")


def same_again(probe: Probe) -> Iterator[Finding]:
    """Whether an answer repeats, and whether it depends on what was asked before."""
    other = probe.changed(lambda part: np.roll(part, 1, axis=0) * 0.5)
    first, second = probe.ask(probe.seen)[0], probe.ask(probe.seen)[0]
    probe.ask(other)
    third = probe.ask(probe.seen)[0]
    if _differ(first, second) == 0.0 and _differ(first, third) == 0.0:
        yield passed("determinism", "the same answer to the same observations")
    elif _differ(first, second) == 0.0:
        yield failed(
            "determinism",
            "its answers depend on earlier calls",
            "carry its memory in the state that predict returns: batches of many scenarios take turns",
        )
    else:
        yield warned(
            "determinism",
            f"its answers vary from call to call, by up to {_differ(first, second):.2g}",
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
    off = _differ(first[begun], again[begun])
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
    shuffled = _differ(probe.ask(probe.changed(lambda part: part[order]))[0], whole[order])
    single = [probe.changed(lambda part, row=row: part[row : row + 1]) for row in range(8)]  # type: ignore[misc]
    alone = _differ(np.concatenate([probe.ask(row)[0] for row in single]), whole[:8])
    for name, off in (("order of the batch", shuffled), ("size of the batch", alone)):
        if off > ROUNDING:
            yield failed(
                name,
                f"actions change with it, by up to {off:.2g}",
                "a row must not depend on the others; is a batch norm in training mode?",
            )
        else:
            yield passed(name, "no effect" if off == 0.0 else f"rounding, {off:.1g}")


def at_the_edges(probe: Probe) -> Iterator[Finding]:
    """Zeros (which rows are shown whose episode is over), the ends of the observation's range, and NaN."""
    space = probe.space
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    cases = {
        "zeros": probe.changed(np.zeros_like),
        "the lower end": each(lambda part, box: _end(box.low, -1.0, part), probe.seen, boxes),
        "the upper end": each(lambda part, box: _end(box.high, 1.0, part), probe.seen, boxes),
    }
    bad = []
    for name, case in cases.items():
        try:
            action, _ = probe.ask(case)
            bad += [] if np.isfinite(action).all() else [f"{name}: NaN or infinite"]
        except (Exception, SystemExit) as error:
            bad.append(f"{name}: {reason_of(error)}")
    if bad:
        yield failed(
            "range",
            "; ".join(bad),
            "such observations come; rows are zeros after a crash",
        )
    else:
        yield passed("range", "finite at zeros and at both ends of what is observed")
    if not isinstance(probe.seen, dict) and probe.seen.dtype == np.uint8:
        return
    try:
        action, _ = probe.ask(each(lambda part: part if part.dtype == np.uint8 else part * np.nan, probe.seen))
        finite = bool(np.isfinite(action).all())
        yield passed("NaN", "answered by numbers; the environment never gives NaN" if finite else "answered by NaN")
    except (Exception, SystemExit) as error:
        yield passed("NaN", f"refused: {reason_of(error)}")


def _end(bound: Array, unbounded: float, part: Array) -> Array:
    """Observations at a bound of their space; where it has none they are scaled to [-1, 1]."""
    return np.broadcast_to(np.where(np.isfinite(bound), bound, unbounded), part.shape).astype(part.dtype)


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


def _differ(one: Array, other: Array) -> float:
    """Largest difference of actions; infinite where shapes or NaN differ."""
    if one.shape != other.shape:
        return np.inf
    apart = np.abs(one.astype(float) - other.astype(float))
    apart[np.isnan(one.astype(float)) & np.isnan(other.astype(float))] = 0.0
    return float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))


def _megabytes() -> float:
    """Memory of this process: at present where the system tells, else at most."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[1]) * 4096 / 2**20
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (2**20 if sys.platform == "darwin" else 2**10)
