"""Refits: the whole fit again, to events drawn anew from the recorded ones, which say how far the events determine it.

Whole clusters are drawn with replacement (the bootstrap of Efron and Tibshirani, "An Introduction to the Bootstrap",
1993, chapter 8): events of one scene depend on each other. All that was chosen by the events is chosen anew in each
refit (Breiman, "Bagging predictors", 1996; Efron, "Estimation and accuracy after model selection", 2014). In two worlds
of car-following refits in the coordinates of the fit gave intervals that held p in 81 and 74 % of 32 and 31 draws of
events, refits that choose 96 and 98 % of 135 and 134 (`benchmarks/uncertainty/recipe_coverage.py`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rare_envs.distributions.events import PredictiveCheck
from rare_envs.distributions.space import Distribution
from training.fit.filters import EventSet, NoSpread

T = TypeVar("T")
N_REFITS = 30
"""Refits where all are of the same family: the noise of log-spread is then .13."""
MIN_CLUSTERS = 5
"""Clusters below which there is nothing to draw anew: refits to so few would all be alike."""
MORE_REFITS = 100
"""Refits where coordinates or number of components differ: one refit alone may then carry the spread."""
FOLD_STARTS = 5
"""Starts of expectation maximisation of the fits to folds and to resampled events.

Fewer than of the fit itself: another local optimum moves log p by .1 to .2, nothing beside the spread of .7 to 1.5 that
other events cause.
"""


class Fit(NamedTuple):
    """What was fitted to events, and what its record says of it."""

    distribution: Distribution
    refits: tuple[Distribution, ...]
    family: str
    """In words."""
    checks: tuple[PredictiveCheck, ...]
    criteria: Mapping[str, Any]
    """Entries of the record: coordinates, and what speaks for them."""
    entries: Mapping[str, Any]
    """Further entries."""
    settings: Mapping[str, Any]
    """Those of the fit, beside the seed."""


@dataclass(frozen=True)
class Asked:
    """How a fit is made."""

    n_refits: int | None = None
    """None: `N_REFITS`, or `MORE_REFITS` where families differ among these."""
    seed: int = 0
    """Of the fits and of what is drawn anew."""
    report: Callable[[str], None] = lambda _: None
    """Told of each fit and refit."""

    def refit(
        self,
        events: EventSet,
        fit: Callable[[EventSet, np.random.Generator], T],
        family: Callable[[T], object] = type,
    ) -> list[T]:
        """Return refits to events drawn anew, none if they are of under `MIN_CLUSTERS`.

        Events that are drawn such that a parameter has one value are drawn again.
        """
        if len(np.unique(events.clusters)) < MIN_CLUSTERS:
            return []
        rng, refits = np.random.default_rng(self.seed), list[T]()
        wanted = N_REFITS if self.n_refits is None else self.n_refits
        while len(refits) < wanted:
            self.report(f"refit {len(refits) + 1} of {wanted}")
            with contextlib.suppress(NoSpread):
                refits.append(fit(draw_events(events, rng), rng))
            if self.n_refits is None and len(refits) == N_REFITS and len({family(each) for each in refits}) > 1:
                wanted = MORE_REFITS
        return refits


def draw_events(events: EventSet, rng: np.random.Generator) -> EventSet:
    """Return as many clusters as there are, drawn with replacement, and columns apart drawn by themselves."""
    names = np.unique(events.clusters)
    rows = [np.flatnonzero(events.clusters == name) for name in rng.choice(names, len(names))]
    labels = np.repeat(np.arange(len(rows)), [len(part) for part in rows])
    apart = events.apart[rng.integers(len(events.apart), size=len(events.apart))] if len(events.apart) else events.apart
    return EventSet(events.joint[np.concatenate(rows)], labels, apart, events.cluster)
