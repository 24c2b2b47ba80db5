"""Screening: a classifier rejects draws that are unlikely to fail, and the importance weights correct for it.

A draw u from a component q is kept with probability a(u) = max(sqrt(P[fail | u]), a_min), which minimises the variance
of the weighted mean if the classifier is right; the density of what is kept is q(u) a(u) / E_q[a]. If it is wrong,
weights grow by 1 / a_min at most, and p-hat stays unbiased. Rejected draws cost no simulation.

References:
    Dubourg, Sudret and Deheeger, "Metamodel-based importance sampling for structural reliability analysis",
    Probabilistic Engineering Mechanics 33, 2013 (the same density with P[fail | u], from a Gaussian process, in place
    of its root, and no a_min: what is rejected is corrected for by a second estimate).
    Platt, "Probabilistic outputs for support vector machines", 1999 (calibration).
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from samplers.methods.two_stage.mixture.settings import DEFAULT_MIXTURE_SETTINGS, ScreeningSettings
from samplers.problem import FloatArray
from samplers.proposals.components import MixtureComponent


@dataclass(frozen=True, eq=False)
class FailureScreen:
    """Acceptance probability of a draw: the root of the probability that it fails, but at least `min_acceptance`."""

    classifier: Any
    """Fitted, with scikit-learn's `decision_function`."""
    intercept: float
    """Of the log odds of failure on the decision function."""
    slope: float
    """Likewise."""
    min_acceptance: float

    def __call__(self, u: FloatArray) -> FloatArray:
        """Return the acceptance probabilities at u (n, d), shape (n,)."""
        odds = self.intercept + self.slope * self.classifier.decision_function(u)
        return np.asarray(np.maximum(np.exp(-0.5 * np.logaddexp(0.0, -odds)), self.min_acceptance))


class LabelledPoints(NamedTuple):
    """Points and whether they fail."""

    u: FloatArray
    """Shape (n, d)."""
    fails: NDArray[np.bool_]
    """Shape (n,)."""

    @property
    def min_class(self) -> int:
        """Number of points in the smaller class."""
        n_failing = int(np.count_nonzero(self.fails))
        return min(n_failing, len(self.fails) - n_failing)


def draw_screened(
    screen: FailureScreen,
    component: MixtureComponent,
    n: int,
    rng: np.random.Generator,
    settings: ScreeningSettings = DEFAULT_MIXTURE_SETTINGS.screening,
) -> FloatArray:
    """Draw n points (n, d) of a component that the screen accepts, by rejection."""
    parts, missing = [component.sample(0, rng)], n
    while missing > 0:
        u = component.sample(settings.spare_factor * missing + settings.spare_draws, rng)
        parts.append(u[rng.random(len(u)) < screen(u)][:missing])
        missing -= len(parts[-1])
    return np.concatenate(parts)


def train_screen(
    known: LabelledPoints,
    fresh: LabelledPoints,
    log_weights: FloatArray,
    settings: ScreeningSettings = DEFAULT_MIXTURE_SETTINGS.screening,
) -> FailureScreen | None:
    """Return the screen for the next draws, or None if none is worth it.

    A support vector machine is trained on the known points, calibrated and judged on fresh ones that it has not seen,
    and then trained on all.

    Args:
        known: Points seen so far.
        fresh: Draws from the last proposal.
        log_weights: log(phi / q) of the fresh draws, shape (m,).
        settings: Penalties, and when a screen is worth it.
    """
    from sklearn.linear_model import LogisticRegression  # slow to import

    if min(known.min_class, fresh.min_class) < settings.min_class_size:
        return None
    classifier = _fit_machine(known, settings)
    decision = classifier.decision_function(fresh.u)
    line = LogisticRegression(C=settings.calibration_penalty, random_state=0).fit(decision[:, None], fresh.fails)
    intercept, slope = float(line.intercept_[0]), float(line.coef_[0, 0])
    if slope <= 0:
        return None
    screens = [FailureScreen(classifier, intercept, slope, least) for least in settings.min_acceptances]
    best = _choose_screen(screens, fresh, log_weights, settings.max_variance_ratio)
    if best is None:
        return None
    both = LabelledPoints(*(np.concatenate(parts) for parts in zip(known, fresh, strict=True)))
    return FailureScreen(_fit_machine(both, settings), intercept, slope, best.min_acceptance)


def _fit_machine(points: LabelledPoints, settings: ScreeningSettings) -> Any:
    """Return a support vector machine trained on points, or on some at equal distances where there are too many."""
    from sklearn.svm import SVC  # slow to import

    n = len(points.u)
    chosen = np.linspace(0, n - 1, min(n, settings.svm_points)).astype(np.int64)
    return SVC(C=settings.svm_penalty, random_state=0).fit(points.u[chosen], points.fails[chosen])


def _choose_screen(
    screens: list[FailureScreen], fresh: LabelledPoints, log_weights: FloatArray, max_variance_ratio: float
) -> FailureScreen | None:
    """Return the screen with the least variance per simulation, None where none is estimated to give enough.

    Behind a screen a term y becomes y E[a] / a(u), drawn with density q a / E[a]: its second moment is E[y^2 / a] E[a].
    """
    w = np.where(fresh.fails, np.exp(log_weights - log_weights[fresh.fails].max()), 0.0)
    mean, square = float(w.mean()), w * w
    best, least = None, max_variance_ratio * (float(square.mean()) - mean**2)
    for screen in screens:
        accepted = screen(fresh.u)
        variance = float((square / accepted).mean()) * float(accepted.mean()) - mean**2
        if variance < least:
            best, least = screen, variance
    return best
