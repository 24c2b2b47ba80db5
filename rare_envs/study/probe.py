"""Probe: an ego in its environment, and the checks of `rare-envs check-ego` that query it.

They are functions from a `Probe` to findings, named by what they check; `EGO_CHECKS` has all of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces

from agents.saved_ego import OUTLYING, SavedEgo
from rare_envs.devices import CAMERA_TILE
from rare_envs.distributions.coordinates import AnyArray
from rare_envs.egos.policy import PolicyDriver
from rare_envs.egos.wrappers import find_frame_stacking, find_inner
from rare_envs.plugins import as_errors, reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.simulation.observation import batch_size, map_kinds, observe
from rare_envs.simulation.world import drive
from samplers.evaluate import Evaluator


@dataclass(frozen=True)
class Finding:
    """One line of the table of a check."""

    check: str
    """The property that was checked."""
    status: Literal["pass", "warn", "fail"]
    found: str
    """The result, in words."""
    advice: str = ""
    """The remedy."""
    doubtful: bool = True
    """Whether, as a warning, it makes an estimate doubtful."""


def judge(
    check: str, bad: str | bool, good: str, advice: str, status: Literal["warn", "fail"] = "warn", doubtful: bool = True
) -> Finding:
    """Return what is bad, if anything, with what to do, else that the check passed with what is good."""
    return Finding(check, status, str(bad), advice, doubtful) if bad else Finding(check, "pass", good)


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
    def has_camera(self) -> bool:
        """Whether it observes pictures, of which a batch is small."""
        return "camera" in self.problem.world.sensing.kinds

    @property
    def policy(self) -> Any:
        """Policy of the ego with the wrappers of its training; None if the ego is a driver."""
        return self.problem.driver.policy if isinstance(self.problem.driver, PolicyDriver) else None

    def change_seen(self, change: Callable[[AnyArray], Any]) -> Any:
        """Return the observations after a function, each of its own type."""
        return map_kinds(lambda part: np.asarray(change(part)).astype(part.dtype), self.seen)

    def repeat_seen(self, size: int) -> Any:
        """Return as many observations as `size`, repeating those that there are."""
        return self.change_seen(lambda part: np.resize(part, (size, *part.shape[1:])))

    def query(self, observation: Any, state: Any = None, start: Any = None) -> tuple[AnyArray, Any]:
        """Return the actions as numbers, and the memory."""
        begun = np.full(batch_size(observation), state is None) if start is None else start
        seen = map_kinds(np.copy, observation)
        with as_errors():
            action, state = self.policy.predict(seen, state=state, episode_start=begun, deterministic=True)
        return np.asarray(action), state

    def act(self, observation: Any) -> AnyArray:
        """Return the actions as numbers, of episodes that begin."""
        return self.query(observation)[0]


def largest_difference(one: AnyArray, other: AnyArray) -> float:
    """Return the largest difference of actions; infinite where shapes or NaN differ."""
    if one.shape != other.shape:
        return np.inf
    apart = np.abs(one.astype(float) - other.astype(float))
    apart[np.isnan(one.astype(float)) & np.isnan(other.astype(float))] = 0.0
    return float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0))


def check_declared_spaces(probe: Probe) -> Iterator[Finding]:
    """Compare declared spaces with the environment's; that they fit at all was found when the problem was made."""
    ours, ours_to_act = probe.problem.world.observation_space, probe.problem.world.action_space
    # the user's ego need not declare anything
    observed, acted = (getattr(probe.ego, name, None) for name in ("observation_space", "action_space"))
    named = {"observation_space": observed, "action_space": acted}
    if missing := " and ".join(name for name, space in named.items() if space is None):
        advice = "taken at its word; declare them, so that a mix-up is noticed"
        yield Finding("spaces", "warn", f"it has no {missing}", advice, False)
    if observed is not None:
        frames, _ = find_frame_stacking(ours, observed) or (1, False)
        stacked = f", {frames} frames of {ours.shape or ours}" if frames > 1 else ""
        words = f"{observed.shape} {observed.dtype}" if observed.shape is not None else str(observed)
        yield Finding("observations", "pass", f"{words}{stacked}")
        real, ours_real = (space.dtype is None or np.issubdtype(space.dtype, np.floating) for space in (observed, ours))
        if observed.dtype is not None and real != ours_real:
            found = f"it was made for {observed.dtype}, here they are {ours.dtype}"
            yield Finding("observations", "warn", found, "train it on these")
    if isinstance(acted, spaces.Box) and isinstance(ours_to_act, spaces.Box):
        same = np.array_equal(acted.low, ours_to_act.low) and np.array_equal(acted.high, ours_to_act.high)
        bounded = np.isfinite(acted.low).any() or np.isfinite(acted.high).any()
        bad = f"from {acted.low.tolist()} to {acted.high.tolist()}, the environment's from -1 to 1"
        good = "in [-1, 1]" if same else "unbounded; clipped to [-1, 1]"
        advice = "they are rescaled, as behind RescaleAction; if its units differ, put a function of yours around it"
        yield judge("action space", bool(bounded) and not same and bad, good, advice)
    elif acted is not None:
        yield Finding("action space", "pass", str(acted))


MANY_OUTLYING = 0.2
"""Share of ordinary scenarios with such observations from which the statistics are most likely of another ego."""


def check_normalisation(probe: Probe) -> Iterator[Finding]:
    """Check whether the VecNormalize statistics of a saved ego suit the observations here."""
    ego = find_inner(probe.ego)
    if not isinstance(ego, SavedEgo):
        return
    name, statistics, path = "normalisation", ego.statistics, ego.statistics_path
    if doubt := ego.find_normalisation_doubt(probe.problem.world.observation_space):
        what, _, advice = doubt.rpartition("; ")
        yield Finding(name, "warn", what, advice)
    elif ego.left_out is not None:
        yield Finding(name, "pass", "; ".join(ego.notes))
    elif statistics is None:
        advice = "if it was trained behind VecNormalize, put vecnormalize.pkl there, or name it with --stats"
        yield Finding(name, "pass", "no VecNormalize statistics beside the file", advice)
    elif not statistics.norm_obs:
        yield Finding(name, "pass", f"{path} does not normalise observations")
    elif isinstance(probe.seen, dict) or probe.seen.ndim > 2:
        yield Finding(name, "pass", f"{path}; of such observations their fit is not checked")
    else:
        size = statistics.observation_space.shape[0]
        seen = np.repeat(probe.seen, size // probe.seen.shape[1], 1)  # frames of a stack are alike at time 0
        beyond = float((np.abs(statistics.normalize_obs(seen)) > OUTLYING).any(axis=1).mean())
        result = f"{path}: {beyond:.0%} of ordinary scenarios are over {OUTLYING:g} standard deviations off"
        advice = "are these the statistics of this policy, and of this environment?"
        yield judge(name, beyond > MANY_OUTLYING and result, result, advice)


def check_actions(probe: Probe) -> Iterator[Finding]:
    """Check shape, type and range of actions on ordinary observations."""
    action, declared = probe.act(probe.seen), getattr(probe.ego, "action_space", None)
    whole = np.issubdtype(action.dtype, np.integer)
    what, shape = f"{action.dtype} of shape {action.shape}", (BATCH_ROWS,) if whole else (BATCH_ROWS, 2)
    bad = advice = ""
    if action.shape != shape or action.dtype == object:
        bad, advice = what, f"return shape {(BATCH_ROWS, 2)}, or {BATCH_ROWS} whole numbers"
    elif n_bad := int((~np.isfinite(action).reshape(BATCH_ROWS, -1).all(axis=1)).sum()):
        bad, advice = f"NaN or infinite for {n_bad} of {BATCH_ROWS} observations", "check weights and normalisation"
    elif declared is not None and isinstance(declared, spaces.Discrete) != whole:
        bad, advice = f"{what}, but it says {declared}", "make both agree"
    if bad:
        yield Finding("actions", "fail", bad, advice)
        return
    if beyond := 0.0 if whole else float((np.abs(action) > 1.0 + 1e-6).mean()):
        far = f"{beyond:.0%} beyond [-1, 1], up to {np.abs(action).max():.3g}"
        yield Finding("actions", "warn", far, "they are clipped", False)
    same = len(np.unique(action.round(6), axis=0)) == 1
    bad = f"the same for all {BATCH_ROWS} observations: {action[0].tolist()}"
    good = f"{action.dtype} of shape (B{', 2' if not whole else ''}), finite"
    yield judge("actions", same and bad, good, "does it look at all?")


def check_extreme_observations(probe: Probe) -> Iterator[Finding]:
    """Query the ego with zeros (rows whose episode is over) and with the bounds of its observations."""
    space = probe.problem.world.observation_space
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else space

    def fill(end: str, unbounded: float) -> Any:
        def of(part: AnyArray, box: spaces.Box) -> AnyArray:
            bound = getattr(box, end)
            return np.broadcast_to(np.where(np.isfinite(bound), bound, unbounded), part.shape).astype(part.dtype)

        return map_kinds(of, probe.seen, boxes)

    cases = {"zeros": probe.change_seen(np.zeros_like)}
    cases |= {"the lower bound": fill("low", -1.0), "the upper bound": fill("high", 1.0)}
    bad = []
    for name, case in cases.items():
        try:
            bad += [] if np.isfinite(probe.act(case)).all() else [f"{name}: NaN or infinite"]
        except Exception as error:
            bad.append(f"{name}: {reason_of(error)}")
    advice = "such observations come; rows are zeros after a crash"
    yield judge("range", "; ".join(bad), "finite at zeros and at both ends of what is observed", advice, "fail")


ACTION_ROUNDING = 1e-3
"""Differences of actions above this are not rounding."""


def check_determinism(probe: Probe) -> Iterator[Finding]:
    """Check whether an answer repeats, and whether it depends on earlier calls."""
    first, second = probe.act(probe.seen), probe.act(probe.seen)
    probe.act(probe.change_seen(lambda part: np.roll(part, 1, axis=0) * 0.5))
    third = probe.act(probe.seen)
    if off := largest_difference(first, second):
        found = f"its answers vary from call to call, by up to {off:.2g}"
        advice = "random, or a memory not in its state; p is then over this too, and failures may not replay"
        yield Finding("determinism", "warn", found, advice)
        return
    bad = largest_difference(first, third) > 0.0 and "its answers depend on earlier calls"
    advice = "carry its memory in the state that predict returns: batches of many scenarios take turns"
    yield judge("determinism", bad, "the same answer to the same observations", advice, "fail")


def check_memory(probe: Probe) -> Iterator[Finding]:
    """Check whether the ego has a memory, and whether it is reset where an episode begins."""
    first, state = probe.query(probe.seen)
    if state is None:
        yield Finding("memory", "pass", "none: an answer depends on one observation")
        return
    for _ in range(2):
        _, state = probe.query(probe.change_seen(lambda part: part * 0.9), state)
    begun = np.arange(BATCH_ROWS) < BATCH_ROWS // 2
    again, _ = probe.query(probe.seen, state, begun)
    off = largest_difference(first[begun], again[begun])
    bad = off > ACTION_ROUNDING and f"kept in its state, but rows that begin an episode are off by {off:.2g}"
    advice = "reset the rows of episode_start; here whole batches begin together, so this may not matter"
    yield judge("memory", bad, "kept in its state, reset where an episode begins", advice, doubtful=False)


def check_row_independence(probe: Probe) -> Iterator[Finding]:
    """Check whether a row's answer depends on the other rows, their order or their number."""
    whole, order = probe.act(probe.seen), np.random.default_rng(1).permutation(BATCH_ROWS)
    shuffled = probe.act(probe.change_seen(lambda part: part[order]))
    single = [probe.act(probe.change_seen(lambda part, row=row: part[row : row + 1])) for row in range(8)]  # type: ignore[misc]
    for name, off in (
        ("order of the batch", largest_difference(shuffled, whole[order])),
        ("size of the batch", largest_difference(np.concatenate(single), whole[:8])),
    ):
        bad = off > ACTION_ROUNDING and f"actions change with it, by up to {off:.2g}"
        good = "no effect" if off == 0.0 else f"rounding, {off:.1g}"
        yield judge(name, bad, good, "a row must not depend on the others; is a batch norm in training mode?", "fail")


TYPICAL_SIMULATIONS = 6000
"""Simulations of a usual estimation, to express latency as its duration."""
SLOW_SECONDS = 3600.0
"""Duration of such an estimation [s] from which latency is worth a warning."""


def check_latency(probe: Probe) -> Iterator[Finding]:
    """Measure the duration of a call by batch size; an ego with a camera never gets a batch above `CAMERA_TILE`."""
    times = {}
    for size in (1, 16, CAMERA_TILE) if probe.has_camera else (1, 64, 1024):
        observation, durations = probe.repeat_seen(size), []
        for _ in range(6 if size == 1 else 4):
            begun = time.perf_counter()
            probe.act(observation)
            durations.append(time.perf_counter() - begun)
        times[size] = float(np.median(durations[1:]))
    calls = ", ".join(f"{1e3 * seconds:.2g} ms for {size}" for size, seconds in times.items())
    needed = TYPICAL_SIMULATIONS / size * times[size] * probe.problem.world.clock.ticks
    duration = "under 1 s" if needed < 1.0 else f"{needed:.0f} s"
    slow = f"{calls}: {needed / 3600:.1f} h for {TYPICAL_SIMULATIONS} simulations"
    good = f"{calls}: {duration} for {TYPICAL_SIMULATIONS} simulations"
    yield judge("latency", needed > SLOW_SECONDS and slow, good, "batch its work", doubtful=False)


LEAK_MEGABYTES = 64.0
"""Growth of the process over 100 calls [MB] from which it is worth a warning."""
STATM = Path("/proc/self/statm")
"""Pages of memory of this process, the second number."""


def check_memory_growth(probe: Probe) -> Iterator[Finding]:
    """Measure by how much the process grows over 100 calls, where the system tells that (Linux)."""
    if not STATM.exists():
        return
    observation = probe.repeat_seen(4 if probe.has_camera else 256)
    used = []
    for calls in (20, 100):
        for _ in range(calls):
            probe.act(observation)
        used.append(int(STATM.read_text().split()[1]) * 4096 / 2**20)
    grown = used[1] - used[0]
    bad = grown > LEAK_MEGABYTES and f"{grown:.0f} MB more after 100 calls"
    good = f"{used[0]:.0f} MB in all, {max(grown, 0.0):.0f} MB more after 100 calls"
    yield judge("space", bad, good, "it keeps what it has seen; a long run ends early", doubtful=False)


MANY_COLLISIONS = 0.5
"""Share of ordinary scenarios: an ego that collides in more has most likely been given wrong inputs."""


def check_driving(probe: Probe) -> Iterator[Finding]:
    """Drive a few ordinary scenarios."""
    evaluator = Evaluator(probe.problem, on_error="failure")
    f = evaluator.evaluate(probe.problem.base.sample(BATCH_ROWS, np.random.default_rng(2)))
    if evaluator.faults:
        failed = f"fails on {len(evaluator.faults)} of {BATCH_ROWS} ordinary scenarios: {evaluator.faults[0].reason}"
        advice = "fix it, or count such scenarios by on_error: failure or bound in a file for --config"
        yield Finding("driving", "fail", failed, advice)
        return
    crashed = float((f == -1.0).mean())
    result = f"collides in {crashed:.0%} of {BATCH_ROWS} ordinary scenarios"
    advice = "does it see and act as in its training? is it trained?"
    yield judge("driving", crashed > MANY_COLLISIONS and result, result, advice)


EGO_CHECKS = (
    *(check_declared_spaces, check_normalisation, check_actions, check_determinism, check_memory),
    *(check_row_independence, check_extreme_observations, check_driving, check_latency, check_memory_growth),
)
