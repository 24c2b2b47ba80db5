"""Predictive checks: what was recorded beside what a fit expects, and beside how simulated drivers go on.

Dangerous initial states, counted in the recorded events, stand beside the counts that a base expects: one fitted to the
bulk of the events may still expect more or fewer, and the probability of a collision depends on these states alone. Of
each recorded start of a lane change the mean accelerations over 2 s of the cutter and of the vehicle behind it, and the
hardest braking of either within 3 s, stand beside those of the cutter of `CutIn-v1` and of the ego "human". Nothing is
fitted to any of these.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

import rare_envs
from rare_envs.distributions.events import PredictiveCheck
from rare_envs.distributions.space import Distribution
from rare_envs.simulation.world import drive
from samplers.problem import FloatArray
from training.data.events import ANSWER_SECONDS, MEAN_SECONDS
from training.data.table import DT

CHECK_DRAWS = 200_000
"""Draws from which an expected count is computed; one in 2,000 events then has an error of 10 %."""
HARD_NEED = 4.9
"""Deceleration of a rapid manoeuvre, half of gravity [m/s^2]."""
State = Callable[[FloatArray, FloatArray, FloatArray], NDArray[np.bool_]]


def needed(behind: FloatArray, ahead: FloatArray, gap: FloatArray) -> FloatArray:
    """Return the deceleration that keeps a vehicle behind from one ahead that keeps its speed, (n,) [m/s^2]."""
    return np.asarray(np.maximum(behind - ahead, 0.0) ** 2 / (2.0 * np.maximum(gap, 0.01)))


CUT_IN_STATES: Mapping[str, State] = {
    **{f"TTC < {t} s": lambda v, ahead, gap, t=t: v - ahead > gap / t for t in (2, 3, 5)},  # type: ignore[misc]
    "needed deceleration > 0.5 m/s^2": lambda v, ahead, gap: needed(v, ahead, gap) > 0.5,
    "needed deceleration > 1 m/s^2": lambda v, ahead, gap: needed(v, ahead, gap) > 1.0,
    "closing": lambda v, ahead, gap: v > ahead,
    "gap < 3 m": lambda v, ahead, gap: gap < 3.0,
}
"""Of speed behind, speed ahead [m/s] and gap [m], (n,) each, where the cutter looked."""
UNSEEN_STATES: Mapping[str, State] = {
    "beside": lambda v, ahead, gap: gap < 0.0,
    "beside or needed deceleration > 4.9 m/s^2": lambda v, ahead, gap: (
        (gap < 0.0) | (needed(v, ahead, gap) > HARD_NEED)
    ),
}
BRAKING_STATES: Mapping[str, State] = {
    "time headway < 0.5 s": lambda speed, gap, peak: gap < 0.5 * speed,
    "gap < 3 m": lambda speed, gap, peak: gap < 3.0,
    "peak > 3 m/s^2": lambda speed, gap, peak: peak > 3.0,
}
DANGEROUS_STATES = {name: CUT_IN_STATES[name] for name in ("TTC < 5 s", "needed deceleration > 1 m/s^2", "gap < 3 m")}
"""Of a scenario without strata."""
PAIRS: Mapping[str, Sequence[tuple[str, str, str]]] = {
    "car_following": (("ego_speed", "lead_speed", "gap"),),
    "cut_in": (("ego_speed", "cut_in_speed", "cut_in_gap"), ("cut_in_speed", "lead_speed", "lead_gap")),
}
"""Parameters of each pair of vehicles whose states are checked, by scenario."""


def check_states(
    states: Mapping[str, State], words: str, recorded: FloatArray, drawn: FloatArray
) -> tuple[PredictiveCheck, ...]:
    """Return recorded and expected counts of states of rows, (n, 3), and of draws (m, 3); {} in words is the state."""
    return tuple(
        PredictiveCheck(
            words.format(name),
            int(occurs(*recorded.T).sum()),
            float(f"{float(occurs(*drawn.T).mean()) * len(recorded):.3g}"),
        )
        for name, occurs in states.items()
    )


def check_predictions(
    scenario: str, names: Sequence[str], events: FloatArray, distribution: Distribution, seed: int = 0
) -> tuple[PredictiveCheck, ...]:
    """Return recorded and expected counts of dangerous states of events (n, k), the first k named columns."""
    groups = PAIRS.get(scenario, ())
    drawn = np.asarray(distribution.sample(CHECK_DRAWS, np.random.default_rng(seed))) if groups else np.empty((0, 0))
    checks: tuple[PredictiveCheck, ...] = ()
    for group in groups:
        columns = [list(names).index(name) for name in group]
        words = "{}" if len(groups) == 1 else f"{{}}, {group[2]}"
        checks += check_states(DANGEROUS_STATES, words, events[:, columns], drawn[:, columns])
    return checks


HARD_BRAKING = 3.4
"""A deceleration that drivers rarely use [m/s^2]: AASHTO's of stopping sight distances."""
DRAWS = 40
"""Of the noise of human drivers, for each start."""
MOST_STARTS = 1000
"""Starts that are driven; of more, so many are chosen evenly."""
COURSE = {"lateral_offset": 3.35, "duration": 4.0, "attention": 0.0, "indicator": -9.0, "lead_braking": 9.0}
"""Of cutters who have looked and do not signal, as no recording tells who did, behind a lead that does not brake;
offset [m] and duration [s] are near the medians of both sites."""
VEHICLES = ("followers", "cutters")


def simulate_answers(starts: FloatArray, draws: int = DRAWS, seed: int = 0) -> FloatArray:
    """Return mean accelerations over 2 s and hardest braking within 3 s of human follower and cutter from starts.

    Args:
        starts: ego_speed, cut_in_speed, lead_speed, cut_in_gap and lead_gap, (n, 5).
        draws: Of the noise of the human driver.
        seed: Of the draws.

    Returns:
        Shape (draws, n, 2, 2): follower and cutter; mean acceleration and hardest braking [m/s^2], 0 if none.

    Example:
        >>> answers = simulate_answers(np.array([[20.0, 12.0, 12.0, 10.0, 40.0]]), draws=2)
        >>> bool((answers[:, 0, 0, 1] > 3.0).all())  # who closes at 8 m/s with 10 m left brakes hard
        True
    """
    problem = rare_envs.DrivingProblem("rare_envs/CutIn-v1", ego="human")
    x = np.random.default_rng(seed).standard_normal((draws, len(starts), problem.dim))
    names = [parameter.name for parameter in problem.world.scenario.parameters]
    x[..., :5] = starts
    for name, value in COURSE.items():
        x[..., names.index(name)] = value
    ticks = [round(seconds / DT) for seconds in (MEAN_SECONDS, ANSWER_SECONDS)]
    steps = round(DT / problem.world.clock.dt)
    speeds = []
    for tick, episode in enumerate(drive(problem.world, problem.driver, torch.from_numpy(x.reshape(-1, problem.dim)))):
        if tick % steps == 0:
            speeds.append(episode.state.speed[:, :2].numpy())
        if len(speeds) > ticks[1]:
            break
    speed = np.stack(speeds).reshape(-1, draws, len(starts), 2)
    mean = (speed[ticks[0]] - speed[0]) / MEAN_SECONDS
    return np.stack([mean, np.maximum(-np.diff(speed, axis=0).min(axis=0) / DT, 0.0)], axis=-1)


def check_answers(starts: FloatArray, recorded: FloatArray) -> dict[str, dict[str, float]]:
    """Return what recorded followers and cutters did beside simulated ones, for the record of a base.

    Args:
        starts: As of `simulate_answers`, (n, 5).
        recorded: What was recorded of them, (n, 2, 2), NaN if it was not.

    Returns:
        By vehicles their number, recorded and simulated mean and the root mean square error of the mean acceleration
        over 2 s [m/s^2], and where it is known the recorded number and the simulated share of those who brake harder
        than 3.4 m/s^2 within 3 s, with the number of recorded ones. Empty if nothing was recorded.
    """
    found: dict[str, dict[str, float]] = {}
    known = np.flatnonzero(np.isfinite(recorded[:, :, 0]).any(axis=1))
    known = known[np.linspace(0, len(known) - 1, min(len(known), MOST_STARTS)).astype(int)]
    if not len(known):
        return found
    answers, recorded = simulate_answers(starts[known]), recorded[known]
    for vehicle, name in enumerate(VEHICLES):
        mean, braking = recorded[:, vehicle].T
        own = np.isfinite(mean)
        if own.any():
            simulated = answers[:, own, vehicle, 0].mean(axis=0)
            found[name] = {
                "events": int(own.sum()),
                "recorded": _round(mean[own].mean()),
                "simulated": _round(simulated.mean()),
                "rmse": _round(np.sqrt(np.square(simulated - mean[own]).mean())),
            }
        seen = np.isfinite(braking)
        if own.any() and seen.any():
            hard = answers[:, seen, vehicle, 1] > HARD_BRAKING
            found[name] |= {"braking": int((braking[seen] > HARD_BRAKING).sum()), "of": int(seen.sum())}
            found[name]["share_simulated"] = _round(hard.mean())
    return found


def _round(value: Any) -> float:
    return round(float(value), 3)
