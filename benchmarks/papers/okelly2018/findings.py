"""Statements of the paper about failures, tested: starts and behaviour of failing runs against ordinary ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from benchmarks.papers.record import Entry, find
from rare_envs.measures.longitudinal import TTC_MAX
from rare_envs.sensors.lidar import RANGE_COLUMNS, RATE_COLUMNS, beam_angles
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import drive
from samplers.problem import FloatArray
from samplers.sample import Interval

NEXT_LANES = (2, 3)
"""Vehicles that start in the lanes beside the ego's, see `rare_envs.scenarios.highway.START_LANES`."""
BESIDE = 10.0
"""Distance along the road within which a neighbour closes the way to its lane [m]."""
STARTS = ("s", "t", "heading", "speed")
RESAMPLES = 999
LEAST_P = 1e-99
"""The least p value that is printed."""
StartColumns = Mapping[str, FloatArray]
"""Scenario parameters by name, (n, 6) each, the ego first."""


class PaperClaim(NamedTuple):
    """A statement of the paper as a ratio of failing runs to ordinary ones."""

    text: str
    above: bool
    """Whether the ratio is to be above 1, else below."""
    printed: float | None = None
    """The ratio that the paper prints."""

    def judge(self, interval: Interval, equal: float = 1.0) -> str:
        """Return what the 95 % interval of the ratio, or of a difference that is 0 where equal, says of the claim."""
        low, high = interval
        if not math.isfinite(low + high):
            return "cannot be told"
        if low <= equal <= high:
            return "not seen here"
        if (low > equal) != self.above:
            return "the opposite here"
        if self.printed is None or low <= self.printed <= high:
            return "holds"
        less = abs(math.log(self.printed)) > max(abs(math.log(max(low, 1e-9))), abs(math.log(high)))
        return f"holds, but {'less' if less else 'more'}: {self.printed:g} in the paper"


def speed_behind(columns: StartColumns) -> FloatArray:
    """Return the mean speed of the vehicles that start behind the ego [m/s], NaN where there is none, shape (n,)."""
    behind = columns["s"][:, 1:] < columns["s"][:, :1]
    count = behind.sum(axis=1)
    total = np.where(behind, columns["speed"][:, 1:], 0.0).sum(axis=1)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def distances_beside(columns: StartColumns) -> FloatArray:
    """Return the distances along the road to the vehicles in the lanes beside [m], shape (n, 2)."""
    return np.asarray(np.abs(columns["s"][:, NEXT_LANES] - columns["s"][:, :1]))


def spread_of_starts(columns: StartColumns, base: StartColumns) -> FloatArray:
    """Return the squared distance of the starts from their own mean, in variances of a base sample, shape (n,).

    Its mean is the ratio of variances to those of the base, averaged over all 24 variables.
    """
    n = len(columns["s"])
    parts = [(columns[name] - columns[name].mean(axis=0)) ** 2 / base[name].var(axis=0, ddof=1) for name in STARTS]
    return np.asarray(np.concatenate(parts, axis=1).mean(axis=1) * n / max(n - 1, 1))


def compare_means(
    claim: PaperClaim, quantity: str, failing: FloatArray, ordinary: FloatArray, groups: str = "failing / ordinary"
) -> Entry:
    """Test a claim on the ratio of two means, a value of each run: Welch's t, and a bootstrap interval of the ratio.

    Where no ordinary run has any of it there is no ratio, and the shares of runs that have any are compared.
    """
    failing, ordinary = failing[~np.isnan(failing)], ordinary[~np.isnan(ordinary)]
    sizes = f"{len(failing):,} and {len(ordinary):,} runs"
    if min(len(failing), len(ordinary)) < 2:
        known = [f"{values.mean():.3g}" if len(values) else "none" for values in (failing, ordinary)]
        return find(claim.text, f"{quantity}, {groups}: {' and '.join(known)}, {sizes}", "cannot be told")
    if not ordinary.any():
        return _compare_shares(claim, f"{quantity}, {groups}", failing, ordinary)
    # equal values in both groups have no spread, and no statistic
    if failing.std() == 0.0 and ordinary.std() == 0.0:
        test = "no spread"
    else:
        tested = stats.ttest_ind(failing, ordinary, equal_var=False)
        test = f"Welch's t = {float(tested.statistic):.1f}, p = {max(float(tested.pvalue), LEAST_P):.1g}"
    statistic = f"{quantity}, {groups}: {failing.mean():.3g} / {ordinary.mean():.3g}; {test}; {sizes}"
    interval = bootstrap_ratio(failing, ordinary)
    return find(claim.text, statistic, claim.judge(interval), float(failing.mean() / ordinary.mean()), interval)


def _compare_shares(claim: PaperClaim, quantity: str, failing: FloatArray, ordinary: FloatArray) -> Entry:
    """Test a claim by the shares of runs that have any of it."""
    counts = [(int(np.count_nonzero(values)), len(values)) for values in (failing, ordinary)]
    interval = difference_interval(*counts)
    tested = stats.fisher_exact(np.array([[k, n - k] for k, n in counts]))
    shares = " and ".join(f"{k:,} of {n:,}" for k, n in counts)
    statistic = (
        f"{quantity}: difference of the shares of runs with any, {shares}; Fisher's exact test, "
        f"p = {float(tested.pvalue):.1g}"
    )
    value = counts[0][0] / counts[0][1] - counts[1][0] / counts[1][1]
    return find(claim.text, statistic, claim._replace(printed=None).judge(interval, equal=0.0), value, interval)


def difference_interval(first: tuple[int, int], second: tuple[int, int]) -> Interval:
    """Return the 95 % interval of a difference of two shares k of n (Newcombe 1998, method 10)."""
    (low, high), (least, most) = (
        map(float, stats.binomtest(k, n).proportion_ci(0.95, method="wilson")) for k, n in (first, second)
    )
    p, q = (k / n for k, n in (first, second))
    return p - q - math.hypot(p - low, most - q), p - q + math.hypot(high - p, q - least)


def bootstrap_ratio(failing: FloatArray, ordinary: FloatArray) -> Interval:
    """Return the 95 % percentile interval of the ratio of two means; the same bits every time."""
    rng = np.random.default_rng(0)
    means = [
        np.array([values[rng.integers(0, len(values), len(values))].mean() for _ in range(RESAMPLES)])
        for values in (failing, ordinary)
    ]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = means[0] / means[1]
    low, high = np.nanpercentile(ratios, [2.5, 97.5])
    return float(low), float(high)


def compare_starts(failing: StartColumns, ordinary: StartColumns, groups: str) -> list[Entry]:
    """Test what the paper says of initial conditions."""
    claims: tuple[tuple[PaperClaim, str, Callable[[StartColumns], FloatArray]], ...] = (
        (
            PaperClaim("vehicles box in the ego", above=True),
            f"share of starts with a vehicle within {BESIDE:g} m in both lanes beside",
            lambda columns: np.asarray((distances_beside(columns) <= BESIDE).all(axis=1), dtype=np.float64),
        ),
        (
            PaperClaim("vehicles box in the ego: neighbours are nearer", above=False),
            "distance to the vehicles in the lanes beside at the start [m]",
            lambda columns: distances_beside(columns).mean(axis=1),
        ),
        (
            PaperClaim("vehicles behind the ego are 20 % faster", above=True, printed=1.2),
            "initial speed of the vehicles that start behind [m/s]",
            speed_behind,
        ),
        (
            PaperClaim("variances of the initial conditions are 50 % smaller", above=False, printed=0.5),
            "variance of the 24 initial values, mean over them, in units of the base's",
            lambda columns: spread_of_starts(columns, ordinary),
        ),
    )
    return [compare_means(claim, words, value(failing), value(ordinary), groups) for claim, words, value in claims]


HARD_BRAKE_LIMIT = -3.0
"""Acceleration that counts as a hard brake [m/s^2]."""
SIDEWAYS_ANGLES = (math.radians(45.0), math.radians(135.0))
"""Angles to the heading between which a beam looks sideways."""


class RunBehaviour(NamedTuple):
    """Each of n runs, (n,) each."""

    hard_brakes: FloatArray
    """Share of the steps of the five other vehicles."""
    lane_changes: FloatArray
    """Of the five other vehicles, for each of them in 10 s."""
    sideways: FloatArray
    """1 where the least time to collision was along a beam to the side, else 0."""
    collided: FloatArray
    """1 where the ego has collided, else 0."""


def measure_behaviour(problem: Any, x: FloatArray) -> RunBehaviour:
    """Drive scenarios again."""
    parts = [_measure_tile(problem, rows) for rows in np.array_split(x, max(1, math.ceil(len(x) / problem.tile)))]
    return RunBehaviour(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def _measure_tile(problem: Any, x: FloatArray) -> RunBehaviour:
    clock = problem.world.clock
    with torch.inference_mode():
        episodes = drive(problem.world, problem.driver, torch.from_numpy(x).float())
        before = next(episodes)
        least, side = find_least_time(before)
        brakes, changes = torch.zeros(len(x)), torch.zeros(len(x))
        for episode in episodes:
            slowing = (episode.state.speed - before.state.speed)[:, 1:] / clock.dt
            brakes += (slowing <= HARD_BRAKE_LIMIT).float().mean(dim=1)
            lane, lane_before = (each.road.lane_of(each.state.y[:, 1:]) for each in (episode, before))
            changes += (lane != lane_before).float().mean(dim=1)
            now, here = find_least_time(episode)
            nearer = (now < least) & ~episode.collided
            least, side = torch.where(nearer, now, least), torch.where(nearer, here, side)
            before = episode
    values = (brakes / clock.ticks, changes * 10.0 / clock.seconds, side.float(), before.collided.float())
    return RunBehaviour(*(value.double().numpy() for value in values))


def find_least_time(episode: Episode) -> tuple[Tensor, Tensor]:
    """Return the least time to collision along the ego's beams [s], and whether that beam looks sideways, (B,) each."""
    assert episode.perception is not None
    ego = episode.perception[:, 0]
    closing = -ego[:, RATE_COLUMNS]
    times = torch.where(closing > 0.0, ego[:, RANGE_COLUMNS] / closing.clamp(min=1e-4), TTC_MAX)
    least, beam = times.min(dim=1)
    angle = beam_angles(times).abs()[beam]
    return least, (angle >= SIDEWAYS_ANGLES[0]) & (angle <= SIDEWAYS_ANGLES[1])


def compare_behaviour(
    failing: RunBehaviour, ordinary: RunBehaviour, with_their_weights: RunBehaviour, all_failing: int
) -> list[Entry]:
    """Test what the paper says of behaviour."""
    groups = "ordinary starts with weights of failing runs / with their own"
    lane_changes = PaperClaim("perturbed weights make lane changes more frequent", above=True)
    hard_brakes = PaperClaim("perturbed weights make hard brakes more frequent", above=True)
    sideswipes = PaperClaim("dangerous events include frequent sideswipes", above=True)
    of_beams = (
        "share of runs whose least time to collision is along a beam to the side (45 to 135 degrees); "
        f"the ego collides in {failing.collided.mean():.0%} of the failing runs, {len(failing.collided):,} of "
        f"{all_failing:,} driven again"
    )
    theirs, own = with_their_weights, ordinary
    return [
        compare_means(lane_changes, "lane changes of a vehicle in 10 s", theirs.lane_changes, own.lane_changes, groups),
        compare_means(
            hard_brakes, "share of steps that brake at 3 m/s^2 or more", theirs.hard_brakes, own.hard_brakes, groups
        ),
        compare_means(sideswipes, of_beams, failing.sideways, ordinary.sideways),
    ]
