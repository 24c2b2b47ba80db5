"""Order of the terms: any method follows the least term in place of f where it asks for f."""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np

from samplers.method import Outcome, Steps, request_terms
from samplers.problem import FloatArray, Terms


def ordering_values(terms: Terms, gamma: float) -> FloatArray:
    """Return values (n,) that are <= gamma just where f is, and elsewhere in the order of the least term.

    Where f is no better than a flag (a collision is -1, however it happened) the least term tells near from far.
    """
    shifted = terms.lowest - terms.threshold + gamma
    above = float(np.nextafter(gamma, np.inf))
    values = np.where(terms.f <= gamma, np.minimum(shifted, gamma), np.maximum(shifted, above))
    return np.where(np.isneginf(terms.f), -np.inf, values)


def order_by_terms(steps: Steps, gamma: float) -> Steps:
    """Run steps with the least term in place of f; the outcome's points have f again.

    Their layers are left out: they are thresholds of the order, not of f.
    """
    f_of: dict[float, float] = {}
    answer: FloatArray | None = None
    while True:
        try:
            x = next(steps) if answer is None else steps.send(answer)
        except StopIteration as end:
            return _with_f(cast(Outcome, end.value), f_of)
        if len(x) == 0:
            answer = np.empty(0)
            continue
        try:
            terms = yield from request_terms(x)
        except BaseException as error:
            try:
                steps.throw(error)
            except StopIteration as end:
                return _with_f(cast(Outcome, end.value), f_of)
            raise
        answer = ordering_values(terms, gamma)
        f_of.update(zip(answer.tolist(), terms.f.tolist(), strict=True))


def _with_f(outcome: Outcome, f_of: dict[float, float]) -> Outcome:
    """Return the outcome with f in place of the order among its points."""
    if outcome.sample is None:
        return outcome
    return replace(outcome, sample=replace(outcome.sample, f=_look_up(outcome.sample.f.tolist(), f_of), layers=()))


def _look_up(values: Sequence[float], f_of: dict[float, float]) -> FloatArray:
    return np.array([f_of.get(value, value) for value in values])
