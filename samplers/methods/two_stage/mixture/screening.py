"""Sparing draws that would hardly fail: a classifier thins the proposal, the weights account for it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray
from samplers.proposals.components import MixtureComponent

ACCEPTANCE_FLOORS = (0.5, 0.25)
"""Shares of the draws that may be kept where the classifier sees no failure."""
MAX_VARIANCE_RATIO = 0.9
"""A screen is used where it promises less than this of the variance without it."""
MIN_CLASS_SIZE = 40
"""Failing, and safe, points that a classifier needs."""


@dataclass(frozen=True, eq=False)
class FailureScreen:
    """With what probability a draw is kept: sqrt of the probability that it fails, but at least `floor`.

    sqrt(pi) is what minimises the variance of a weighted mean of outcomes that fail with probability pi.
    """

    classifier: Any
    """Fitted, with `decision_function`."""
    intercept: float
    slope: float
    """Of the log odds of failure on the decision function."""
    floor: float

    def __call__(self, u: FloatArray) -> FloatArray:
        """Return the probabilities at u (n, d), shape (n,)."""
        odds = self.intercept + self.slope * self.classifier.decision_function(u)
        return np.asarray(np.maximum(np.exp(-0.5 * np.logaddexp(0.0, -odds)), self.floor))


def draw_screened(screen: FailureScreen, component: MixtureComponent, n: int, rng: np.random.Generator) -> FloatArray:
    """Draw n points (n, d) of a component that pass the screen, by rejection."""
    parts, missing = [component.sample(0, rng)], n
    while missing > 0:
        u = component.sample(2 * missing + 20, rng)
        parts.append(u[rng.random(len(u)) < screen(u)][:missing])
        missing -= len(parts[-1])
    return np.concatenate(parts)


def train_screen(
    known: tuple[FloatArray, NDArray[np.bool_]], fresh: tuple[FloatArray, NDArray[np.bool_]], log_weights: FloatArray
) -> FailureScreen | None:
    """Return the screen for the next draws, or None if none is worth it.

    A support vector machine learns from the known points, is calibrated and judged on fresh ones that it has not
    seen, and then learns from all.

    Args:
        known: GroupedPoints u (n, d) and whether they fail (n,).
        fresh: Draws from the last proposal u (m, d) and whether they fail (m,).
        log_weights: log(phi / q) of the fresh draws, shape (m,).
    """
    from sklearn.linear_model import LogisticRegression  # slow to import
    from sklearn.svm import SVC

    (u, fails), (u_new, fails_new) = known, fresh
    for seen in (fails, fails_new):
        if min(np.count_nonzero(seen), np.count_nonzero(~seen)) < MIN_CLASS_SIZE:
            return None
    classifier = SVC(C=10.0, random_state=0).fit(u, fails)
    decision = classifier.decision_function(u_new)
    line = LogisticRegression(C=100.0, random_state=0).fit(decision[:, None], fails_new)
    intercept, slope = float(line.intercept_[0]), float(line.coef_[0, 0])
    if slope <= 0:
        return None
    w = np.where(fails_new, np.exp(log_weights - log_weights[fails_new].max()), 0.0)
    mean, square = float(w.mean()), w * w
    best, least = None, MAX_VARIANCE_RATIO * (float(square.mean()) - mean**2)
    for floor in ACCEPTANCE_FLOORS:
        screen = FailureScreen(classifier, intercept, slope, floor)
        accepted = screen(u_new)
        variance = float((square / accepted).mean()) * float(accepted.mean()) - mean**2
        if variance < least:
            best, least = floor, variance
    if best is None:
        return None
    both = SVC(C=10.0, random_state=0).fit(np.concatenate([u, u_new]), np.concatenate([fails, fails_new]))
    return FailureScreen(both, intercept, slope, best)
