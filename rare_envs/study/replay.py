"""Replay: one scenario, or a failure that a run has recorded, driven again, every moment of it kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.measures import Moment
from rare_envs.problem import DrivingProblem
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import drive
from rare_envs.study.arguments import BadInput, as_bad_input, read_question
from rare_envs.study.episodes import MAX_SHOWN, format_value
from rare_envs.study.question import open_run, prepare, warn_of_changed_files
from rare_envs.study.run_folder import FAILURES, load_finished
from rare_envs.traffic.crash import describe_crash
from rare_envs.traffic.road import Road
from samplers.problem import FloatArray

REPLAY_TOLERANCE = 1e-3
"""Largest difference of f to the recorded one: products of networks round differently by batch size."""
OWN_NOISE = "ego_noise"
"""Parameter that an ego has which is random itself."""


@dataclass(frozen=True, eq=False)
class Drive:
    """T + 1 moments of N vehicles, the ego first; the last one is the collision, if there is one.

    Example:
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0", horizon=1.0)
        >>> drive = drive_again(problem, np.array([10.0, 10.0, 50.0]))
        >>> drive.position.shape, float(drive.gap[0]), drive.collided, drive.names
        ((11, 2, 2), 50.0, False, ('the ego', 'the lead'))
    """

    problem: DrivingProblem
    """The world and its ego."""
    episodes: tuple[Episode, ...]
    """The moments, each a batch of one."""
    time: FloatArray = field(init=False)
    """Time [s], shape (T + 1,)."""
    position: FloatArray = field(init=False)
    """Centres, along and across the road [m], shape (T + 1, N, 2)."""
    heading: FloatArray = field(init=False)
    """Heading [rad], shape (T + 1, N)."""
    speed: FloatArray = field(init=False)
    """Speed [m/s], shape (T + 1, N)."""
    gap: FloatArray = field(init=False)
    """Bumper to bumper from the ego to its lead [m], shape (T + 1,)."""
    closing_speed: FloatArray = field(init=False)
    """Of the ego on its lead, positive when closing [m/s], shape (T + 1,)."""
    f_so_far: FloatArray = field(init=False)
    """Safety measure of the episode up to each moment, shape (T + 1,)."""

    def __post_init__(self) -> None:
        """Put the moments side by side."""
        states, leads = [each.state for each in self.episodes], [each.lead for each in self.episodes]
        for name, moments in {
            "position": [torch.stack((state.x[0], state.y[0]), dim=-1) for state in states],
            "heading": [state.heading[0] for state in states],
            "speed": [state.speed[0] for state in states],
            "gap": [lead.gap[0] for lead in leads],
            "closing_speed": [lead.closing_speed[0] for lead in leads],
            "f_so_far": [each.f[0] for each in self.episodes],
            "time": list(torch.arange(len(states), dtype=torch.float64) * self.problem.world.clock.dt),
        }.items():
            object.__setattr__(self, name, torch.stack(moments).double().numpy())

    @cached_property
    def f_alone(self) -> FloatArray:
        """Safety measure of each moment as if it were the whole episode, shape (T + 1,)."""
        clock, values = self.problem.world.clock, []
        for before, episode in zip([None, *self.episodes], self.episodes, strict=False):
            state = None if before is None else before.state
            moment = Moment(episode.state, episode.lead, episode.road, episode.perception, state, clock.dt)
            values.append(float(episode.measure.f(episode.measure.start(moment, clock.ticks))))
        return np.array(values)

    @property
    def worst(self) -> int:
        """Index of the moment that decides f: the collision, else the least measure."""
        return int(self.f_so_far.argmin())

    @property
    def f(self) -> float:
        """Safety measure of the whole drive."""
        return float(self.f_so_far[-1])

    @property
    def collided(self) -> bool:
        """Whether the ego collided."""
        return bool(self.episodes[-1].collided)

    @property
    def crash(self) -> dict[str, Any] | None:
        """The crash, as `rare_envs.traffic.crash.describe_crash` gives it; None if nobody crashed."""
        statistics = self.episodes[-1].statistics
        return None if statistics is None else describe_crash(statistics.crash)

    @property
    def road(self) -> Road:
        """The road that the vehicles are on."""
        return self.problem.world.scenario.road

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the vehicles, length N."""
        return self.problem.world.scenario.labels


@torch.inference_mode()
def drive_again(problem: DrivingProblem, x: NDArray[np.float64], beyond: bool = False) -> Drive:
    """Drive one scenario and keep every moment up to the collision or the horizon.

    Args:
        problem: The world and its ego.
        x: Scenario parameters, shape (d,).
        beyond: Go on to the horizon after a collision, for what the other vehicles would have done.

    Returns:
        The drive, made on the CPU; its f is that of `problem.evaluate`, but for rounding where that is on a GPU.

    Example:
        >>> problem = DrivingProblem("rare_envs/CarFollowing-v0", horizon=3.0)
        >>> drive = drive_again(problem, np.array([20.0, 5.0, 10.0]))  # ego at 20 m/s, 10 m behind a lead at 5 m/s
        >>> drive.f, drive.crash["kind"], round(float(drive.time[-1]), 1)
        (-1.0, 'rear_end', 0.8)
    """
    episodes: list[Episode] = []
    # single precision, as in `DrivingProblem.evaluate`, so that f comes out the same
    world, driver = problem.on_cpu()
    rows = torch.from_numpy(x).float()[None]
    for episode in drive(world.with_statistics(), driver, rows):
        episodes.append(episode)
        if bool(episode.collided) and not beyond:
            break
    episodes[-1] = problem.settle(episodes[-1], rows.to(problem.device))
    return Drive(problem, tuple(episodes))


class RecordedFailure(NamedTuple):
    """A failure as a run has recorded it."""

    problem: DrivingProblem
    x: FloatArray
    """Scenario parameters, shape (d,)."""
    f: float
    log_p0: float
    n_listed: int
    """Number of failures that the run lists, the most likely ones."""
    n_found: int
    """Number of failures that it found."""


def find_failure(folder: Path, number: int, trust: bool = False, ego: str | None = None) -> RecordedFailure:
    """Return failure `number` of a run, 0 being the most likely; with another ego in its world, if one is named."""
    run = load_finished(folder)
    given = {} if ego is None else {"ego": ego, **dict.fromkeys(("algo", "stats", "observation", "action"))}
    question, table, count = open_run(run, trust, **given), run.failures, len(run.failures["f"])
    warn_of_changed_files(read_question(run.question), folder)
    if not count:
        raise BadInput("The run has no failure.")
    if not 0 <= number < count:
        raise BadInput(f"Expected a failure from 0 to {count - 1}, got {number}.")
    with as_bad_input(TypeError, OverflowError, RecursionError, MemoryError):
        problem = prepare(question).problem
    x, found = read_row(table, problem, number), run.result.get("n_failures")
    n_found = found if isinstance(found, int) and found > count else count
    return RecordedFailure(problem, x, float(table["f"][number]), float(table["log_p0"][number]), count, n_found)


def read_row(table: Mapping[str, NDArray[Any]], problem: DrivingProblem, number: int) -> FloatArray:
    """Return x (d,) of a row of the failures of a run."""
    names = [name for name in problem.space.names if name in table]
    try:
        x = join_parts({name: table[name][number] for name in names}, problem.space)
    except ValueError as error:
        wanted = ", ".join(problem.space.names)
        raise BadInput(f"Expected {FAILURES} with the columns {wanted}; the run is of another problem.") from error
    if not np.isfinite(x).all() or not np.isfinite(problem.base.log_prob(x[None])).all():
        raise BadInput(f"Failure {number} in {FAILURES} is no scenario of {problem.env_id} and its traffic model.")
    return x


def join_parts(parts: Mapping[str, Any], space: ScenarioSpace) -> FloatArray:
    """Return x (d,) from the values of its parameters by name."""
    found = []
    for name, size in zip(space.names, space.sizes, strict=True):
        part = np.atleast_1d(np.asarray(parts.get(name, ()), dtype=np.float64))
        if len(part) != size and name != OWN_NOISE:
            raise ValueError(f"has {len(part)} values of {name}, its scenario has {size}")
        found.append(part if len(part) == size else np.zeros(size))
    return np.concatenate(found)


def describe_drive(recorded: RecordedFailure, drive: Drive, number: int, ego: str | None = None) -> list[str]:
    """Return the drive in words, line by line."""
    space = recorded.problem.space
    listed = f" ({recorded.n_listed:,} of them listed)" if recorded.n_listed < recorded.n_found else ""
    lines = [
        f"Failure {number} of {recorded.n_found:,} found{listed} in {recorded.problem.env_id}: "
        f"f = {drive.f:.4g}, log p0 = {recorded.log_p0:.2f}"
    ]
    for name, values in space.named(recorded.x).items():
        unit = space.units[space.names.index(name)]
        several = np.atleast_1d(values)
        shown = " ".join(map(format_value, several)) if len(several) <= MAX_SHOWN else f"{len(several)} values"
        lines.append(f"  {name:<15} {shown} {unit}".rstrip())
    end, crash = drive.time[-1], drive.crash
    if crash is None:
        lines.append(f"No crash within {end:.1f} s; the worst moment was at {drive.time[drive.worst]:.1f} s.")
    else:
        how = f"{describe_contact(crash, drive.names)}, closing at {crash['closing_speed']:.1f} m/s"
        lines.append(f"Crash after {end:.1f} s: {how}.")
    if ego is not None:
        lines.append(f"The ego was {ego}; that of the run had f = {recorded.f:.4g}.")
    elif abs(drive.f - recorded.f) > REPLAY_TOLERANCE:
        why = "ego, drivers or this program have changed since"
        if recorded.problem.varies:
            why = "the ego answers differently from run to run, and what was recorded is what counts"
        lines.append(f"warning: the run recorded f = {recorded.f:.4g}; {why}.")
    return lines


VERBS = {"rear_end": "rear-ends", "rear_ended": "rear-ends", "side": "sideswipes"}
"""What the first vehicle of a crash does to the second, by the kind of crash; "hits" in others."""


def describe_contact(crash: Mapping[str, Any], labels: Sequence[str]) -> str:
    """Return who ran into whom in a crash, and how, by the labels of the vehicles."""
    who, whom = ("the edge of the road" if one < 0 else labels[one] for one in crash["vehicles"])
    return f"{who} {VERBS.get(crash['kind'], 'hits')} {whom}"
