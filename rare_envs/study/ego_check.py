"""`rare-envs check-ego`: does an ego fit, before simulations are spent on it?

The ego is loaded and asked in a process of its own, which may hang or die without ending the check. Its checks are
functions from a `Probe` to findings, named by what they check; `EGO_CHECKS` has all of them. A server is held against
the protocol of docs/egos.md over its socket, message by message.
"""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from gymnasium import spaces
from loky.backend import get_context
from rich.table import Table
from rich.text import Text

import agents
from agents.files import report_missing_file
from agents.loading import EGO_SUFFIXES, EXPECTED_EGO, find_ego_kind, strip_prefixes, suggest_ego
from agents.safe_pickle import TRUST_ADVICE, TRUST_CONSEQUENCE, find_origin_risks
from agents.saved_ego import OUTLYING, SavedEgo, find_statistics
from rare_envs.devices import CAMERA_TILE
from rare_envs.distributions.coordinates import AnyArray
from rare_envs.egos.needs import AMBIGUOUS, TAKEN_AS_ACCELERATIONS
from rare_envs.egos.policy import PolicyDriver
from rare_envs.egos.wrappers import find_frame_stacking, find_inner
from rare_envs.plugins import EgoGone, NoAnswer, as_errors, reason_of
from rare_envs.problem import DrivingProblem
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.observation import batch_size, map_kinds, observation_space, observe
from rare_envs.simulation.world import drive
from rare_envs.startup import advise_install, use_one_thread
from rare_envs.study.arguments import BadInput, Question, as_bad_input
from rare_envs.study.question import build_problem
from rare_envs.study.text import CleanConsole
from samplers.evaluate import Evaluator
from samplers.workers import SAFE_PATH, starting_processes

MEASUREMENTS = ("driving", "latency")
"""Checks whose result is of interest though it passed."""
STYLES = {"pass": "green", "warn": "yellow", "fail": "bold red"}
VERDICTS = {
    0: "The ego can be used.",
    2: "The ego cannot be used as it is.",
    3: "The ego can be used; mind the warnings.",
}


@dataclass(frozen=True)
class Finding:
    """One line of the table of a check.

    Example:
        >>> exit_code([Finding("memory", "pass", "none"), Finding("actions", "warn", "NaN", "check the weights")])
        3
    """

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


def exit_code(findings: list[Finding]) -> int:
    """Return 0 if the ego can be used, 2 if it cannot, 3 if it can but an estimate for it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0


def print_findings(findings: list[Finding], title: str, everything: bool = False) -> None:
    """Print findings with their remedies, and the verdict; one line if all passed and not everything is asked for."""
    console = CleanConsole(highlight=False, markup=False)
    if not everything and all(each.status == "pass" for each in findings):
        console.print(f"{title} can be used: {len(findings)} checks passed (details: --all)")
        return
    table = Table("check", "", "found", "what to do", title=title, title_justify="left", title_style="bold")
    passed = []
    for each in findings:
        if everything or each.status != "pass" or each.advice or each.check in MEASUREMENTS:
            status = Text(each.status, style=STYLES[each.status])
            table.add_row(each.check, status, each.found, each.advice)
        else:
            passed.append(each.check)
    if passed:
        count = f"{len(passed)} other{'s' if len(passed) > 1 else ''}"
        table.add_row(count, Text("pass", style=STYLES["pass"]), ", ".join(passed), "")
    console.print(table)
    console.print(VERDICTS[exit_code(findings)])


START_TIMEOUT, COMPILING_TIMEOUT = 60.0, 600.0
"""Durations that the process may take before its first check, and for compiling rollouts [s]."""


def check_ego(question: Question, time_limit: float = 30.0) -> list[Finding]:
    """Check the ego of a question in the problem of that question."""
    with as_bad_input(ValueError):
        find_scenario(question.env_id)
    if time_limit <= 0:
        raise BadInput(f"Expected a time limit of some seconds, got {time_limit}.")
    name = strip_prefixes(question.ego)
    kind, path, found = find_ego_kind(name), Path(name), list[Finding]()
    if kind == "url":
        advice = "download the file, look where it comes from, name it"
        return [Finding("origin", "fail", f"{name!r} is a remote place", advice)]
    if kind == "unknown":
        raise BadInput(f"Unknown ego {name!r}{suggest_ego(name)}; expected {EXPECTED_EGO}.")
    if kind != "function" and name.endswith(EGO_SUFFIXES) and not path.exists():
        raise BadInput(report_missing_file(path))
    if kind == "zip":
        reasons = "; ".join(find_origin_risks(path, find_statistics(path)))
        held = f"a Stable-Baselines3 .zip can hold code{f' ({reasons})' if reasons else ''}"
        if question.trust:
            found.append(Finding("origin", "warn", held, f"you said --trust: {TRUST_CONSEQUENCE}", False))
        elif reasons:
            return [Finding("origin", "fail", reasons, TRUST_ADVICE)]
        else:
            found.append(Finding("origin", "pass", f"{held}; opened here is only what is known to be harmless"))
    return [*found, *_check_in_subprocess(question, time_limit)]


def _check_in_subprocess(question: Question, time_limit: float) -> Iterator[Finding]:
    """Yield the findings of a process that is started anew, and a failure if it hangs or dies."""
    context = get_context("loky")  # the main script is not run again, as it is by multiprocessing
    with starting_processes():
        received, sent = context.Pipe(duplex=False)
        process = context.Process(target=_send_findings, args=(question, sent))
        process.start()
    sent.close()  # so that its end is noticed
    doing, limit = "loading", max(START_TIMEOUT, time_limit)
    try:
        while received.poll(limit):
            event, limit = received.recv(), time_limit
            if event is None:
                return
            if isinstance(event, Finding):
                yield event
            else:
                doing, limit = event, COMPILING_TIMEOUT if event == "compiling" else time_limit
        advice = "an ego that hangs stops the run; process:EGO?timeout=SECONDS would end it there"
        yield Finding(doing, "fail", f"no end after {limit:g} s", advice)
    except EOFError:
        process.join()
        advice = "an ego that ends its process ends the run; process:EGO would survive it"
        yield Finding(doing, "fail", f"the process ended (exit status {process.exitcode})", advice)
    finally:
        if process.is_alive():
            os.kill(process.pid, getattr(signal, "SIGKILL", signal.SIGTERM))
        process.join()


def _send_findings(question: Question, to: Connection) -> None:
    """Run the checks in that process: send each finding, before each check its name, and None at the end."""
    os.environ.pop(SAFE_PATH, None)
    os.dup2(2, 1)  # an ego may print
    with use_one_thread():
        for each in run_checks(question):
            to.send(each)
    to.send(None)


def run_checks(question: Question) -> Iterator[Finding | str]:
    """Load the ego and check it: yield findings, and before each check its name."""
    if find_ego_kind(question.ego) == "remote":
        yield "protocol"
        findings = list(check_protocol(question.ego))
        yield from findings
        if any(finding.status == "fail" for finding in findings):
            return
    yield "loading"
    try:
        ego = agents.load_ego(question.ego, algo=question.algo, trust=question.trust, stats=question.stats)
        yield Finding("loading", "pass", ego if isinstance(ego, str) else type(ego).__name__)
        yield "compiling"  # takes no time of a check
        problem = build_problem(question, ego)
        for note in problem.notes:
            if note in (AMBIGUOUS, TAKEN_AS_ACCELERATIONS):  # of other bounds than ours a check of its own tells
                yield Finding("action space", "warn", note, "say which by --action", note == AMBIGUOUS)
            elif note in problem.needs.notes:
                yield Finding("loading", "warn", note, "see docs/egos.md", False)
        probe = Probe.of(ego, problem)
        if problem.core == "numba":  # then the ego is not asked
            problem.evaluate(problem.base.sample(1, np.random.default_rng(0)))
    except (Exception, SystemExit, EgoGone) as error:  # the ego is the user's: anything may happen in it
        yield Finding("loading", "fail", reason_of(error), "see docs/egos.md for what an ego is")
        return
    for check in EGO_CHECKS if probe.policy is not None else (check_driving,):
        yield (name := check.__name__.removeprefix("check_").replace("_", " "))
        try:
            yield from check(probe)
        except (Exception, SystemExit, EgoGone) as error:  # likewise
            gone = isinstance(error, EgoGone)
            yield Finding(name, "fail", reason_of(error), "start it again" if gone else "the ego failed in this check")
            if gone:
                return


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
PROTOCOL_ADVICE = "docs/egos.md has the protocol"


def check_protocol(spec: str) -> Iterator[Finding]:
    """Check a server."""
    try:
        from agents.remote import protocol
        from agents.remote.client import TIMEOUT, LinkError, RemoteError, ServerLink, parse_address
    except ImportError:
        yield Finding("protocol", "fail", "pyzmq and msgpack are not installed", advise_install("remote"))
        return
    address, settings = parse_address(spec)
    link, numbers = ServerLink(address, protocol.read_secret()), itertools.count(1)

    def ask(message: Any) -> Any:
        content = message if isinstance(message, bytes) else protocol.pack({"id": next(numbers), **message})
        return protocol.unpack(link.request(content, settings.get("timeout", TIMEOUT)))

    def compare(name: str, kind: str, reply: Any) -> Finding:
        found, reason = reply.get("type"), reply.get("reason", "")
        if found == kind:
            return Finding(name, "pass", f"{kind}: {reason}" if kind == "error" and reason else kind)
        return Finding(name, "fail", f"got {found!r} ({reason}), expected {kind!r}", PROTOCOL_ADVICE)

    try:
        link.open()
        before = ask({"type": "ping"})
        link.open()
        hello = ask({"type": "hello", "protocol": protocol.PROTOCOL, "client": "check-ego"})
        if hello.get("type") != "hello" or hello.get("protocol") != protocol.PROTOCOL:
            yield Finding("handshake", "fail", f"{hello.get('reason', hello)}", PROTOCOL_ADVICE)
            return
        yield Finding("handshake", "pass", f"protocol {protocol.PROTOCOL}, {hello.get('name', 'no name')!r}")
        yield compare("before hello", "error", before)
        for name, (kind, *messages) in _list_cases(hello).items():
            replies = [ask(message) for message in messages]
            steps = [isinstance(message, dict) and "step" in message for message in messages]
            acts = [reply for reply, step in zip(replies, steps, strict=True) if step]
            yield compare(name, kind, next((reply for reply in acts if reply.get("type") != kind), replies[-1]))
    except (LinkError, RemoteError, NoAnswer, EgoGone, ValueError) as error:
        yield Finding("protocol", "fail", reason_of(error), f"is it running at {address}? {PROTOCOL_ADVICE}")
    finally:
        link.close()


def _list_cases(hello: Any) -> dict[str, tuple[Any, ...]]:
    """Return the cases after the handshake: the reply to the last of some messages.

    A query has blank observations of the space that the server has declared.
    """
    from agents.remote import protocol

    space = protocol.decode_space(hello.get("observation")) or observation_space(vehicles=2)
    parts = dict(space.spaces) if isinstance(space, spaces.Dict) else space

    def act(session: int, step: int, rows: int = 3) -> dict[str, Any]:
        blank = map_kinds(lambda part: np.zeros((rows, *part.shape), part.dtype), parts)
        return {"type": "act", "session": session, "step": step, "observation": protocol.pack_observation(blank)}

    reset, ping = {"type": "reset", "session": 1, "batch": 3}, {"type": "ping"}
    one, other = ({**reset, "session": session} for session in (11, 12))
    empty = {"dtype": "<f4", "shape": [3, 7], "data": b""}
    return {
        "heartbeat": ("pong", ping),
        "unknown type": ("error", {"type": "dance"}),
        "no msgpack": ("error", b"\xc1 not a message"),
        "cut short": ("error", b"\x82\xa4type\xa5res"),
        "no reset": ("error", act(99, 0)),
        "reset": ("ready", reset),
        "act": ("action", act(1, 0)),
        "act again": ("action", act(1, 1)),
        "another step": ("error", act(1, 7)),
        "another batch": ("error", reset, act(1, 0, rows=4)),
        "data missing": ("error", reset, {**act(1, 0), "observation": empty}),
        "two sessions": ("action", one, other, act(11, 0), act(12, 0), act(11, 1), act(12, 1)),
        "end": ("ended", {"type": "end", "session": 1}),
        "after it all": ("pong", ping),
    }
