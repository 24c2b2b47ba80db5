"""Order of the terms: any method follows the least term in place of f where it asks for f."""

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from typing import TypeVar, cast

import numpy as np

from samplers.method import Outcome, Steps, request_terms
from samplers.problem import FloatArray, Terms

_T = TypeVar("_T")


def ordering_values(terms: Terms, gamma: float) -> FloatArray:
    """Return values (n,) that are <= gamma just where f is, and elsewhere in the order of the least term.

    Where f is no better than a flag (a collision is -1, however it happened) the least term tells near from far.
    """
    shifted = terms.lowest - terms.threshold + gamma
    above = float(np.nextafter(gamma, np.inf))
    values = np.where(terms.f <= gamma, np.minimum(shifted, gamma), np.maximum(shifted, above))
    return np.where(np.isneginf(terms.f), -np.inf, values)


def answer_by_terms(
    steps: Generator[FloatArray, FloatArray, _T], read: Callable[[FloatArray, Terms], FloatArray]
) -> Generator[FloatArray, FloatArray, _T]:
    """Run steps that ask for f, with terms requested in its place; return what they return.

    Args:
        steps: Yields points x (n, d), is sent numbers (n,).
        read: Gives these numbers from points and their terms.
    """
    answer: FloatArray | None = None
    while True:
        try:
            x = next(steps) if answer is None else steps.send(answer)
        except StopIteration as end:
            return cast(_T, end.value)
        if len(x) == 0:
            answer = np.empty(0)
            continue
        try:
            terms = yield from request_terms(x)
        except BaseException as error:
            try:
                steps.throw(error)
            except StopIteration as end:
                return cast(_T, end.value)
            raise
        answer = read(x, terms)


def order_by_terms(steps: Steps, gamma: float) -> Steps:
    """Run steps with the least term in place of f; the outcome's points have f again.

    Their layers are left out: they are thresholds of the order, not of f.
    """
    f_of: dict[float, float] = {}

    def read(_: FloatArray, terms: Terms) -> FloatArray:
        answer = ordering_values(terms, gamma)
        f_of.update(zip(answer.tolist(), terms.f.tolist(), strict=True))
        return answer

    return _with_f((yield from answer_by_terms(steps, read)), f_of)


def _with_f(outcome: Outcome, f_of: dict[float, float]) -> Outcome:
    """Return the outcome with f in place of the order among its points."""
    if outcome.sample is None:
        return outcome
    return replace(outcome, sample=replace(outcome.sample, f=_look_up(outcome.sample.f.tolist(), f_of), layers=()))


def _look_up(values: Sequence[float], f_of: dict[float, float]) -> FloatArray:
    return np.array([f_of.get(value, value) for value in values])
