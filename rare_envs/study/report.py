"""Report: the answer to a question, with its failures, the kinds of their crashes, its rates and the ego's faults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

import samplers
from agents.saved_ego import SavedEgo
from rare_envs.distributions.events import EventFrequency
from rare_envs.egos.wrappers import find_inner, find_normalisation_doubt
from rare_envs.exposure import MILLION_KM, CollisionRate, TotalRate, explain_no_frequency, normal_quantile, read_source
from rare_envs.measures.base import Measure
from rare_envs.measures.registry import MEASURES
from rare_envs.people import COUNTED, EventCalibration, EventRate, calibration
from rare_envs.scenarios.registry import complete_id, find_scenario
from rare_envs.study.arguments import Question
from rare_envs.study.failures import CrashKinds
from rare_envs.study.question import Study
from samplers import analysis
from samplers.analysis.base_error import FIT_BIAS, BaseUncertainty
from samplers.analysis.gate import find_doubt, judge_ends, widen_ends
from samplers.analysis.reweight import find_fitted_base, refit_quantile
from samplers.evaluate import Fault
from samplers.output import say
from samplers.problem import read_strata
from samplers.sample import Interval

N_THRESHOLDS = 25
REACH = 0.5
"""P[f <= g] at the largest threshold."""
COLLISION_MEASURE = "ttc"
"""The measure to advise: -1 after a collision and above 0 without one."""
MODEL_NOUN = "traffic model"
"""What a traffic model of scenarios is called."""
ENSEMBLE_REASON = (
    "the parameters of an ensemble are those of all its refits; without ensemble: true there are derivatives"
)
"""Why there are no derivatives of the mean over refits."""


def compute_threshold_curve(estimate: samplers.Estimate) -> samplers.Curve | None:
    """Return p over thresholds, up to that at which `REACH` of the weight lies; None if the run does not tell it."""
    sample = estimate.sample
    if sample is None or estimate.p <= 0:
        return None
    order = np.argsort(sample.f, kind="stable")
    below = np.cumsum(sample.weights[order])
    top = float(sample.f[order][min(int(np.searchsorted(below, REACH * below[-1])), len(order) - 1)])
    if not np.isfinite(top) or top <= estimate.gamma:
        return None
    try:
        return estimate.curve(np.linspace(estimate.gamma, top, N_THRESHOLDS))
    except ValueError:  # too few failing points
        return None


def explain_other_events(question: Question) -> str:
    """Return which option makes a question count other events than collisions of the ego; empty if none does."""
    measure = MEASURES.get(question.measure)
    if not (isinstance(measure, Measure) and measure.collisions_only):
        advised = f"counts other events than collisions (--measure {COLLISION_MEASURE} does)"
        return f"--measure {question.measure} {advised}"
    # where it is no number, f is graded by the crash
    if not (measure.collision if isinstance(measure.collision, float) else 0.0) <= question.gamma <= 0:
        return f"--gamma {question.gamma:g} counts other events than collisions (--gamma 0 does)"
    if question.collisions != "ego":
        return f"collisions: {question.collisions} counts those between other vehicles too"
    return ""


def find_frequency(study: Study) -> EventFrequency:
    """Return the frequency of the events whose failures a question counts, or raise a ValueError that says why not."""
    base, reason = study.fitted, explain_other_events(study.question)
    if not reason and study.problem.world.policies:
        reason = f"events are counted in ordinary traffic, not with --drivers {study.question.drivers}"
    if not reason and base is not None and base.frequency is not None:
        return base.frequency
    if not reason:
        name = find_scenario(study.question.env_id).name
        reason = f"the base {study.base_name!r} of {name} has no event frequency, "
        reason += explain_no_frequency({} if base is None else base.record)
    raise ValueError(f"no rate per km: {reason}")


def fold_spread(uncertainty: samplers.analysis.BaseUncertainty | None) -> tuple[float, float]:
    """Return t over the normal quantile, by which errors grow, and that of log p from its base; 1 and 0 if unknown."""
    if uncertainty is None or not math.isfinite(uncertainty.spread):
        return 1.0, 0.0
    quantile = refit_quantile(uncertainty.confidence, len(uncertainty.value_refits) - 1, uncertainty.clusters)
    fold = quantile / normal_quantile(uncertainty.confidence)
    return fold, fold * math.hypot(uncertainty.spread, FIT_BIAS)


def describe_left_out(study: Study, estimate: samplers.Estimate) -> str:
    """Return which error the intervals leave out, and why; empty if they hold all."""
    base, reason = estimate.base_uncertainty, ""
    if study.question.ensemble:
        reason = "p is a mean over its bootstrap refits instead"
    elif estimate.p == 0:
        reason = "not known before a failure counts in p"
    else:
        reason = "it has no bootstrap refits" if base is None else base.reason.rstrip(".")
    return say("error not known", model=MODEL_NOUN, reason=reason) if reason else ""


def has_exact_bound(estimate: samplers.Estimate) -> bool:
    """Return whether the answer is the upper limit, exactly: no simulation failed, and all are draws from the base."""
    return estimate.status is samplers.Status.NO_HITS and estimate.base_draws == estimate.n_sim


def describe_traffic(study: Study) -> str:
    """Return the traffic model of a study, and the options that make other traffic of it."""
    changed = [name for name in ("drivers", "horizon") if getattr(study.question, name) is not None]
    return f"{study.base_name} with {' and '.join(changed)}" if changed else study.base_name


def find_calibration(event: str, study: Study) -> EventCalibration | None:
    """Return the calibration of an event in the traffic of a study; None if nobody measured it.

    It is that of the newest version of the scenario: the scripts of earlier ones have drivers as there are none.
    """
    env_id = study.question.env_id
    newest = complete_id(find_scenario(env_id).name) == env_id.rpartition(":")[2]
    return calibration(event, describe_traffic(study)) if newest else None


def bound_shares(estimate: samplers.Estimate) -> list[float]:
    """Return the upper limit of the share of each of `estimate.parts`: no more of the events can end in a collision.

    It is that of a log-normal share with the spread of the refits; the share itself if the base has none.
    """
    shares, fitted = [part.share for part in estimate.parts], find_fitted_base(estimate.base)
    if fitted is None or len(fitted.refits) < 2 or fitted.clusters < 2:
        return shares
    of_refits = np.array([[stratum.share for stratum in read_strata(refit)] for refit in fitted.refits])
    quantile = refit_quantile(estimate.confidence, len(of_refits) - 1, fitted.clusters)
    largest = shares * np.exp(quantile * np.log(of_refits).std(axis=0, ddof=1))
    return [float(each) for each in np.minimum(largest, 1.0)]


def list_part_errors(estimate: samplers.Estimate) -> list[BaseUncertainty | None]:
    """Return what the events behind the base leave open of share times p of each of `estimate.parts`, share included.

    None if nothing failed, or the base has no refits.
    """
    try:
        failures = analysis.weigh_failures(estimate)
    except ValueError:  # nothing failed, or p is no sum over points
        return [None] * len(estimate.parts)
    strata, found = read_strata(estimate.base), list[BaseUncertainty | None]()
    which = np.argmax([each.base.log_prob(failures.x) for each in strata], axis=0)  # densities are 0 in the others
    for number, part in enumerate(estimate.parts):
        here = (which == number).astype(np.float64)
        own = analysis.FailureExpectation(
            value=part.share * part.p,
            interval=(part.share * part.interval[0], part.share * part.interval[1]),
            confidence=estimate.confidence,
            cov=part.cov,
            per_failure=part.of_sum,
        )
        found.append(analysis.expect_under_refits(estimate, failures, here, own) if here.any() else None)
    return found


class Repeatability(NamedTuple):
    """Simulations done again, in another order and company."""

    n: int
    """How many."""
    n_differing: int
    """With another f."""
    largest: float
    """Largest difference of f."""
    n_elsewhere: int | None = 0
    """Answers of an ego `module:function` that are others in another process; None if it gave none there."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON; no number of a difference that is infinite, as to a scenario without f."""
        return {**self._asdict(), "largest": self.largest if math.isfinite(self.largest) else None}

    @property
    def warning(self) -> str:
        """Doubt about p; "" if none differ."""
        if self.n_differing:
            return (
                f"{self.n_differing} of {self.n} simulations gave another f when repeated in another order, by up to "
                f"{self.largest:.2g}: the ego or the measure is random, keeps a memory between calls, or mixes the "
                "rows of a batch. p may be wrong by any factor; rare-envs check-ego looks for the cause"
            )
        if self.n_elsewhere:
            return (
                f"the ego gave {self.n_elsewhere} other answers in another process: they depend on the process (its "
                "number, PYTHONHASHSEED), so p is that of this process alone"
            )
        return ""


def judge_rate(
    limit: float, rate: CollisionRate | TotalRate, reason: str, includes_base: bool
) -> samplers.analysis.Verdict:
    """Return whether a rate is below a limit, its traffic model's error judged or not; undecided for a reason."""
    about: dict[str, Any] = {"quantity": "collisions per million km", "includes_base": includes_base}
    return judge_ends(limit, rate.interval_per_million_km, rate.confidence, reason, **about)


@dataclass(frozen=True)
class Report:
    """Answer to a question.

    Attributes:
        study: The question and what it names.
        estimate: The estimate of the method.
        seconds: Wall time of the estimation [s], that before interruptions included.
        faults: Scenarios on which the ego failed twice.
        n_retried: Simulations that were repeated to find them; not in n_sim.
        kinds: Crashes in which the failures ended.
        repeatability: Simulations done again at the end, not in n_sim; None if that was not done.
        lost: What of the folder could not be written, though the run went on; "" if nothing.
        earlier_seconds: Wall time before the run was resumed the last time [s]; 0 if it never was.

    Example:
        >>> from rare_envs.study import Question, prepare, run
        >>> question = Question(
        ...     env_id="rare_envs/CarFollowing-v0", base="us101-gap", gamma=3.0, horizon=3.0, method="mc", max_sim=1000
        ... )
        >>> report = run(prepare(question))
        >>> report.estimate.failures.total, report.doubtful, report.crashes[0]
        (21, False, None)
    """

    study: Study
    estimate: samplers.Estimate
    seconds: float
    faults: tuple[Fault, ...] = ()
    kinds: CrashKinds = field(default_factory=CrashKinds)
    n_retried: int = 0
    repeatability: Repeatability | None = None
    lost: str = ""
    earlier_seconds: float = 0.0

    @cached_property
    def sensitivity(self) -> samplers.analysis.Sensitivity | str | None:
        """What p is sensitive to, or the reason why that is not known; None if the question does not ask for it."""
        if not self.study.question.sensitivity:
            return None
        space, ensemble = self.study.problem.space, self.study.question.ensemble
        try:
            found = self.estimate.sensitivity(space.names, space.sizes, parameters=not ensemble)
            return replace(found, reason=ENSEMBLE_REASON) if ensemble else found
        except ValueError as error:
            return str(error)

    @property
    def average(self) -> str:
        """What p is a mean over, in words; empty where it is p under one distribution."""
        base = self.study.fitted
        if not self.study.question.ensemble or base is None:
            return ""
        return f"mean over the {len(base.refits)} refits of {self.study.base_name}"

    @property
    def doubtful(self) -> bool:
        """Whether there is a warning that p, or the error of its traffic model, may be wrong."""
        return bool(self.warnings)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Doubts about p: of the method, the traffic model, the ego's statistics, and f as a function."""
        base = self.estimate.base_uncertainty
        doubts = () if base is None else tuple(f"{MODEL_NOUN}: {text}" for text in base.warnings)
        return (*self.doubts_of_method, *doubts, *self.doubts_of_f)

    @property
    def doubts_of_method(self) -> tuple[str, ...]:
        """Warnings of the estimate, but for that of an exact upper limit."""
        return () if has_exact_bound(self.estimate) else self.estimate.warnings

    @property
    def doubts_of_f(self) -> tuple[str, ...]:
        """Doubts about the ego's statistics, and f as a function; the estimate's own warnings are not among them."""
        again = "" if self.repeatability is None else self.repeatability.warning
        return tuple(filter(None, (self.doubt_of_statistics, again)))

    @property
    def doubt_of_statistics(self) -> str:
        """What seems wrong with the ego's `VecNormalize` statistics, such as that there are none; empty if nothing."""
        problem = self.study.problem
        return find_normalisation_doubt(problem.ego, problem.world.observation_space)

    @property
    def vec_normalize(self) -> str | None:
        """File of the `VecNormalize` statistics that were applied to a saved ego's observations, if there was one."""
        ego = find_inner(self.study.problem.ego)
        applied = isinstance(ego, SavedEgo) and ego.statistics is not None and ego.statistics.norm_obs
        return str(ego.statistics_path) if applied else None

    @property
    def remarks(self) -> tuple[str, ...]:
        """Facts about how the run went that do not question the numbers."""
        return (*(self.estimate.warnings if has_exact_bound(self.estimate) else ()), *self.estimate.remarks)

    @property
    def notes(self) -> tuple[str, ...]:
        """Options that make no difference here, notes of the problem, what is not known, what the rate leaves out."""
        world, noise = self.study.problem.world, self.study.question.noise
        found = list(self.study.problem.notes)
        drivers_vary = world.background is not None and world.background.noisy
        if noise is not True and not world.sensing.weather and not drivers_vary:
            word = "off" if noise is False else noise
            found.insert(0, f"noise: {word} changes nothing: no driver here has noise (see --drivers)")
        found += [f"kinds of crash are not known: {self.kinds.unknown}"] if self.kinds.unknown else []
        found += [f"what {name} would do is not known: {why}" for name, why in self.kinds.others_unknown.items()]
        found += [f"sensitivity is not known: {self.sensitivity}"] if isinstance(self.sensitivity, str) else []
        if self.repeatability is not None and self.repeatability.n_elsewhere is None:
            found.append("the ego gave no answer in another process, so whether it answers the same there is not known")
        found += [self.lost] if self.lost else []
        left_out = "" if self.no_rate else describe_left_out(self.study, self.estimate)
        return (*found, *([f"not in the intervals: {left_out}"] if left_out else []))

    @property
    def crashes(self) -> tuple[dict[str, Any] | None, ...]:
        """The crash of each listed failure, see `rare_envs.traffic.crash.describe_crash`; None if nobody crashed."""
        return self.kinds.listed or (None,) * len(self.estimate.failures)

    @cached_property
    def verdict(self) -> samplers.analysis.Verdict | None:
        """Whether p, or the rate, is below the limit of the question; None without a limit."""
        question = self.study.question
        if question.max_rate is None and question.max_p is None:
            return None
        found = self._judge(question.assume_traffic)
        return replace(found, if_exact=self._judge(True).decision if found.includes_base else None)

    def _judge(self, assume_traffic: bool) -> samplers.analysis.Verdict:
        limit, reason = self.study.question.max_rate, self.find_indecision(assume_traffic)
        if limit is not None:
            rate, judged = self.find_judged_rate(assume_traffic), self.judges_traffic(assume_traffic)
            return judge_rate(limit, rate, reason, judged)
        found = self.estimate.meets(self.study.question.max_p or 0.0, assume_traffic)
        return replace(found, decision="undecided", reason=reason) if reason else found

    def judges_traffic(self, assume_traffic: bool) -> bool:
        """Return whether a verdict takes the error of the traffic model into account."""
        return not assume_traffic and self.estimate.base_uncertainty is not None

    def find_indecision(self, assume_traffic: bool) -> str:
        """Return why nothing can be said of any limit, if traffic is taken as exact or not; empty if something can."""
        return self.estimate.meets(0.5, assume_traffic).reason or find_doubt(self.doubts_of_f)

    def find_judged_rate(self, assume_traffic: bool) -> CollisionRate:
        """Return the rate whose ends are compared with a limit: with the errors of the base, or taken as exact."""
        estimate = self.estimate
        rate = self._rate_of(estimate.p, estimate.cov, estimate.interval, None) if assume_traffic else self.rate
        assert rate is not None and rate.interval is not None  # `run` has looked for the frequency before
        return replace(rate, interval=widen_ends(estimate, rate.interval))

    @cached_property
    def curve(self) -> samplers.Curve | None:
        """Probability over the threshold, from the same simulations; None if the run does not tell it."""
        return compute_threshold_curve(self.estimate)

    @cached_property
    def no_rate(self) -> str:
        """Why there is no rate; empty if there is one."""
        try:
            find_frequency(self.study)
        except ValueError as error:
            return str(error)
        return ""

    @cached_property
    def rate(self) -> CollisionRate | None:
        """Collisions per million km; None if `no_rate` says why there are none."""
        estimate = self.estimate
        return self._rate_of(estimate.p, estimate.cov, estimate.interval, estimate.base_uncertainty)

    @cached_property
    def events(self) -> tuple[EventRate, ...]:
        """The rate of each kind of event that the scenario stands for; empty if `no_rate` says why there is none."""
        whole, parts = self.rate, self.estimate.parts
        if whole is None:
            return ()
        apart = bool(parts) and all(part.name in COUNTED for part in parts)
        found = self._rate_parts(whole) if apart else [(whole.scenario, 1.0, whole)]
        shares = {} if apart or not self.estimate.p else {part.name: part.of_sum for part in parts}
        scale, vague = MILLION_KM * whole.frequency.per_km, [part for part in parts if not part.resolved]
        bounds = {} if apart else {part.name: scale * part.share * part.interval[1] for part in vague}
        doubtful = [part.name for part in vague if apart and part.p > 0]
        return tuple(
            EventRate(
                event=name,
                share=share,
                rate=rate,
                parts=shares,
                unresolved={name: rate.interval_per_million_km[1]} if name in doubtful else bounds,
                traffic=describe_traffic(self.study),
                calibration=find_calibration(name, self.study),
            )
            for name, share, rate in found
        )

    def _rate_parts(self, whole: CollisionRate) -> list[tuple[str, float, CollisionRate]]:
        """Return name, share and rate of each stratum, at most that of the whole, and one collision in each event.

        Of a stratum that is not resolved the upper limit alone is known, and refits of what was found say nothing.
        """
        assert whole.interval is not None  # `_rate_of` gives it
        found, estimate = [], self.estimate
        for part, error, most in zip(estimate.parts, list_part_errors(estimate), bound_shares(estimate), strict=True):
            low, of_base = (part.interval[0], error) if part.resolved else (0.0, None)
            ends = part.share * low, part.share * part.interval[1]
            rate = self._rate_of(part.share * part.p, part.cov, ends, of_base, min(most, whole.interval[1]))
            assert rate is not None  # as there is one of the whole
            found.append((part.name, part.share, rate))
        return found

    @cached_property
    def injury_rate(self) -> CollisionRate | None:
        """Serious injuries (MAIS 3 or more) per million km; None if there is no rate, or no collision."""
        severity = self.kinds.severity
        if severity is None:
            return None
        injuries = severity.injuries
        return self._rate_of(injuries.value, injuries.cov, injuries.interval, severity.injuries_base)

    def _rate_of(
        self,
        value: float,
        cov: float,
        sampling: Interval,
        uncertainty: samplers.analysis.BaseUncertainty | None,
        most: float = 1.0,
    ) -> CollisionRate | None:
        """Return the rate of what has a value per event, at most that of the whole: with its base's interval if any."""
        if self.no_rate:
            return None
        (low, high), fold, base_sd = sampling, 1.0, 0.0
        if not (value > 0 and math.isfinite(cov)):
            low, cov = 0.0, 0.0
        elif uncertainty is not None and math.isfinite(uncertainty.spread):
            fold, base_sd = fold_spread(uncertainty)
            low, high = uncertainty.interval or (0.0, high if uncertainty.bound is None else uncertainty.bound)
        base = self.study.fitted
        data = "" if base is None else read_source(base.record)["data"]  # rates of bases of the same events say so
        return CollisionRate(
            scenario=self.study.problem.world.scenario.name,
            frequency=find_frequency(self.study),
            p=value,
            sampling_log_sd=fold * cov,
            base_log_sd=base_sd,
            interval=(min(low, most), min(high, most)),
            confidence=self.estimate.confidence,
            fitted_to=f"{base.fitted_to}, {data}" if base is not None and data else "",
        )

    @cached_property
    def other_bases(self) -> dict[str, samplers.analysis.Reweighted | str]:
        """P with the other traffic models that the question names, by name, or why this run does not give it."""
        found: dict[str, samplers.analysis.Reweighted | str] = {}
        for name, base in self.study.other_bases.items():
            try:
                found[name] = self.estimate.reweight(base)
            except ValueError as error:
                found[name] = str(error)
        return found
