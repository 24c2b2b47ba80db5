"""Run: the dialogue between methods and whoever makes the simulations."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from samplers.execution.arguments import Plan
from samplers.execution.combination import combined, combined_cov, pooled_counts
from samplers.execution.evaluation_log import Ledger
from samplers.execution.progress import Listener, Monitor, Progress
from samplers.execution.replicate import Lane
from samplers.method import Goal, Outcome, Stepping
from samplers.problem import FloatArray
from samplers.result import Estimate
from samplers.statistics.intervals import gain_over_monte_carlo
from samplers.trace import Status

LEAST_REPLICATES = 5
"""Runs made at least where those asked for miss target_cov: fewer give a useless t interval."""
MOST_REPLICATES = 200
"""Runs after which target_cov is given up."""


class Run:
    """An estimation whose simulations are made elsewhere.

        run = CrossEntropy().start(problem, seed=0)
        while not run.done:
            run.tell(simulate(run.ask()))
        print(run.result())

    Replicates run side by side: `ask` gives the points that all of them wait for, one after the
    other. Each has its own generator and its own share of max_sim, fixed beforehand, so that the
    answer is that of the same runs one after another. Runs added for target_cov come one at a time.

    Args:
        plan: The arguments, as `checked` returns them.
        listener: Given `Progress` after every batch and every level.
    """

    def __init__(self, plan: Plan, listener: Listener | None = None) -> None:
        self._plan = plan
        self._ledger = Ledger(plan.inputs.dim, plan.inputs.base, plan.goal.gamma, plan.on_error)
        self._monitor = Monitor(listener, plan.goal.max_sim)
        self._asked: FloatArray | None = None
        self._stopped: str | None = None
        self._lanes: list[Lane] = []
        for share in shares(plan.goal.max_sim, plan.replicates):
            self._add_lane(share)
        self._add_lanes_for_target()

    @property
    def done(self) -> bool:
        """Whether there is nothing more to simulate."""
        return not any(lane.live for lane in self._lanes)

    @property
    def progress(self) -> Progress:
        """How far the run has come."""
        return self._monitor.progress

    def ask(self) -> FloatArray:
        """Return the points to simulate next, shape (n, d); the same ones until their outcomes are told.

        Raises:
            RuntimeError: If the run is done.
        """
        if self.done:
            raise RuntimeError("The run is done: nothing more to simulate; see result().")
        if self._asked is None:
            self._asked = np.concatenate([lane.waiting for lane in self._lanes])
        return self._asked.copy()

    def tell(self, f: ArrayLike) -> None:
        """Tell the outcomes f, shape (n,), of the points that `ask` gave, in their order.

        After an `EvaluationError` nothing has been taken in and f can be told again.

        Raises:
            EvaluationError: If there is not one number per point, or one is NaN (on_error "raise").
            RuntimeError: If nothing has been asked for, or the method asks for more than max_sim.
        """
        if self._asked is None:
            raise RuntimeError("Nothing has been asked for: call ask() for points, then tell() their outcomes.")
        x = self._asked
        seen = self._ledger.enter(x, f)
        self._asked = None
        self._monitor.on_batch(self._ledger.n_sim)
        live = [lane for lane in self._lanes if lane.live]
        ends = np.cumsum([len(lane.waiting) for lane in live])
        for lane, part in zip(live, np.split(seen, ends[:-1]), strict=True):
            lane.tell(part)
        self._add_lanes_for_target()

    def stop(self, why: str = "Stopped") -> None:
        """End the run here; the result is what has been told so far. Nothing happens to a run that is done.

        Args:
            why: First words of the warning that the result will carry.
        """
        if self.done:
            return
        self._stopped = f"{why} after {self._ledger.n_sim:,} simulations, before the method had come to its end."
        self._asked = None
        self._lanes = [lane for lane in self._lanes if lane.n_sim] or self._lanes[:1]
        for lane in self._lanes:
            if lane.live:
                lane.interrupt()

    def result(self) -> Estimate:
        """Return the estimate; a run that is not done is stopped."""
        self.stop()
        plan, outcomes = self._plan, self._outcomes()
        whole = combined(outcomes, plan.goal.confidence)
        low, high = whole.interval
        if plan.on_error == "bound":
            low *= 1 - whole.no_outcome_share
        status, doubts = self._ending(whole, met_target(plan, outcomes))
        return Estimate(
            p=whole.p,
            interval=(low, high),
            confidence=plan.goal.confidence,
            cov=whole.cov,
            gamma=plan.goal.gamma,
            n_sim=self._ledger.n_sim,
            gain=gain_over_monte_carlo(whole.p, whole.cov, self._ledger.n_sim),
            status=status,
            warnings=(*whole.warnings, *self._about_errors(), *doubts),
            trace=whole.trace,
            failures=self._ledger.failures,
            method=plan.method,
            seed=plan.seed,
            sample=whole.sample,
            base=plan.inputs.base,
            on_error=plan.on_error,
            base_draws=whole.base_draws,
            given=plan.given,
        )

    def _outcomes(self) -> list[Outcome]:
        return [lane.outcome for lane in self._lanes if lane.outcome is not None]

    def _ending(self, whole: Outcome, met: bool) -> tuple[Status, list[str]]:
        """Return the status of the whole and the warnings that go with it."""
        if self._stopped is not None:
            return Status.STOPPED, [self._stopped]
        if met:
            return whole.status, []
        status = Status.BUDGET if whole.status is Status.CONVERGED else whole.status
        return status, [f"The target c.o.v. {self._plan.goal.target_cov:g} was not met: {whole.cov:.3g}."]

    def _about_errors(self) -> list[str]:
        if self._ledger.n_errors == 0:
            return []
        text = f"{self._ledger.n_errors} simulations gave no outcome and were counted as failing"
        return [f"{text} (not in the lower end of the interval)." if self._plan.on_error == "bound" else f"{text}."]

    def _add_lane(self, max_sim: int | None) -> None:
        """Start one more run of the method, with a generator of its own."""
        plan, number = self._plan, len(self._lanes)
        target = None if plan.goal.target_cov is None else plan.goal.target_cov * math.sqrt(plan.replicates)
        goal = replace(
            plan.goal,
            max_sim=max_sim,
            target_cov=target,
            on_level=lambda level: self._monitor.on_level(replace(level, run=number)),
        )
        rng = np.random.default_rng(np.random.SeedSequence(plan.seed, spawn_key=(number,)))
        self._lanes.append(Lane(plan.method.steps(plan.inputs, goal, rng), goal, plan.inputs.dim))

    def _add_lanes_for_target(self) -> None:
        """Where all runs are done, the target is missed and the budget allows, start one more."""
        while self.done and wants_another(self._plan, self._lanes):
            max_sim = self._plan.goal.max_sim
            self._add_lane(None if max_sim is None else max_sim - self._ledger.n_sim)


def shares(max_sim: int | None, replicates: int) -> list[int | None]:
    """Return each replicate's part of max_sim; they differ by 1 at most and add up to it."""
    if max_sim is None:
        return [None] * replicates
    return [max_sim * (i + 1) // replicates - max_sim * i // replicates for i in range(replicates)]


def met_target(plan: Plan, outcomes: list[Outcome]) -> bool:
    """Return whether these runs together meet target_cov (as they do where there is none)."""
    if plan.goal.target_cov is None:
        return True
    few = plan.replicates < len(outcomes) < LEAST_REPLICATES and pooled_counts(outcomes) is None
    return not few and combined_cov(outcomes) <= plan.goal.target_cov


def wants_another(plan: Plan, lanes: list[Lane]) -> bool:
    """Return whether finished runs miss the target and one more may be made.

    It may not where as many runs as `replicates` have come to the limit of their method, 200 are
    made, or too little of max_sim is left: less than the longest run took, save for runs that
    pool, which can be cut short (beside longer ones, a short run would spoil a mean).
    """
    outcomes = [lane.outcome for lane in lanes if lane.outcome is not None]
    if met_target(plan, outcomes) or len(lanes) >= MOST_REPLICATES:
        return False
    if sum(at_limit(plan.method, lane.goal, lane.outcome) for lane in lanes) >= plan.replicates:
        return False
    left = plan.goal.budget - sum(lane.n_sim for lane in lanes)
    return left >= (1 if pooled_counts(outcomes) is not None else max(lane.n_sim for lane in lanes))


def at_limit(method: Stepping, goal: Goal, outcome: Outcome | None) -> bool:
    """Return whether a run that goes on until its target ended without it."""
    target = goal.target_cov
    return method.stops_at_target and target is not None and outcome is not None and outcome.cov > target
