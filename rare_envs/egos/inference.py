"""Inference: a policy is queried for the actions of a batch, and rows on which it fails are found."""

from __future__ import annotations

import math
import reprlib
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import read_actions
from rare_envs.egos.errors import EgoGone, NoAnswer, reason_of
from rare_envs.sensors.kinds import map_kinds


class PolicyQuery(NamedTuple):
    """A query of B rows."""

    observation: Any
    """Shape (B, ...), or several of that kind by name."""
    hidden: Any
    """The policy's memory; None at the start, and always if it has none."""
    start: NDArray[np.bool_]
    """Rows that begin an episode, shape (B,)."""
    over: Tensor
    """Rows whose action does not matter, boolean, shape (B,), on the CPU as all of it."""

    def rows(self, part: slice) -> PolicyQuery:
        """Return some of the rows, for a policy without a memory."""
        return PolicyQuery(map_kinds(lambda one: one[part], self.observation), None, self.start[part], self.over[part])


def query_policy(
    policy: Any, kind: str, query: PolicyQuery, failed_rows: dict[int, str] | None = None
) -> tuple[Tensor, Any]:
    """Return a policy's actions for a batch.

    Args:
        policy: Has Stable-Baselines3's `predict`.
        kind: Of its actions, "continuous" or "meta".
        query: The rows.
        failed_rows: Takes the rows on which it fails, with the reason; they get the action of a row that does not
            matter.

    Returns:
        What `rare_envs.control.actions.read_actions` makes of its actions, and its memory.

    Raises:
        Exception: It fails and failed_rows is None, or it fails on a batch that cannot be split because the policy has
            a memory.
    """
    if failed_rows is None:
        try:
            action, hidden = _predict(policy, query)
        except NoAnswer:  # its connection may have been lost
            action, hidden = _predict(policy, query)
        return read_actions(kind, action, len(query.start), query.over), hidden
    try:
        actions, hidden, reasons = _query_with_reasons(policy, kind, query)
    except EgoGone:
        raise
    except (Exception, SystemExit) as error:  # the policy is the user's: anything may happen in it
        parts = None if query.hidden is not None else _isolate_failing_rows(policy, kind, query, error)
        if parts is None:
            raise
        hidden, (actions, reasons) = None, parts
    failed_rows.update(reasons)
    return actions, hidden


def _predict(policy: Any, query: PolicyQuery) -> tuple[Tensor, Any]:
    with np.errstate():  # a policy that sets NumPy's errors sets them for itself
        action, hidden = policy.predict(
            query.observation, state=query.hidden, episode_start=query.start, deterministic=True
        )
    actions = np.asarray(action)
    if actions.dtype.kind not in "biuf":
        raise ValueError(f"Expected actions as numbers, one or two for each observation, got {reprlib.repr(action)}.")
    return torch.as_tensor(actions), hidden


def _query_with_reasons(policy: Any, kind: str, query: PolicyQuery) -> tuple[Tensor, Any, dict[int, str]]:
    """Return actions, memory, and the reasons of rows with actions that are not finite."""
    action, hidden = _predict(policy, query)
    bad = _not_finite(action, query.over)
    reasons = dict.fromkeys(bad.nonzero()[:, 0].tolist(), "NaN or infinite actions")
    return read_actions(kind, action, len(query.start), query.over | bad), hidden, reasons


def _not_finite(action: Tensor, over: Tensor) -> Tensor:
    """Return the rows that matter whose actions are not finite, boolean, shape (B,)."""
    if action.is_floating_point() and action.ndim == 2 and len(action) == len(over):
        return ~torch.isfinite(action).all(dim=1) & ~over
    return torch.zeros_like(over)


def _isolate_failing_rows(
    policy: Any, kind: str, query: PolicyQuery, error: BaseException
) -> tuple[Tensor, dict[int, str]] | None:
    """Query again, after an error, in parts until the rows that fail stand alone.

    The rule is that of `samplers.workers.split_rows`, for the rows of one tick: no other tick is driven again.

    Returns:
        Actions and reasons by row; None if the policy turns out to have a memory.

    Raises:
        EgoGone: The ego cannot be queried any more.
    """
    whole = len(query.start)
    actions, reasons = list[Tensor](), dict[int, str]()
    waiting: list[tuple[int, int, BaseException | None]] = [(0, whole, error)]
    while waiting:
        first, n, met = waiting.pop()
        part = query.rows(slice(first, first + n))
        if met is None:
            try:
                found, hidden, why = _query_with_reasons(policy, kind, part)
            except (Exception, SystemExit) as raised:  # the policy is the user's: anything may happen in it
                met = raised
            else:
                if hidden is not None:
                    return None
                actions.append(found)
                reasons.update({first + row: reason for row, reason in why.items()})
                continue
        elif n == 1 and not isinstance(met, NoAnswer):
            waiting.append((first, 1, None))  # once more
            continue
        if n == 1:
            actions.append(_ignored_action(kind, part.over))
            reasons[first] = reason_of(met)
            continue
        size = _part_size(n, met, whole)
        starts = range(first, first + n, size)
        waiting += [(start, min(size, first + n - start), None) for start in reversed(starts)]
    return torch.cat(actions), reasons


def _part_size(n: int, error: BaseException, whole: int) -> int:
    """Return how many of n rows to query at a time after an error: half of them, as that takes the fewest queries.

    If no answer came, queries are cheap, but waiting for one that does not come, or for a process that starts again, is
    not: then the root of the whole batch, and after that each row alone.
    """
    root = math.isqrt(whole) if isinstance(error, NoAnswer) else (n + 1) // 2
    return root if 1 < root < n else 1


def _ignored_action(kind: str, over: Tensor) -> Tensor:
    """Return the action of rows whose action does not matter, for as many rows as `over` has."""
    batch = len(over)
    nothing = torch.zeros(batch, dtype=torch.int64) if kind == "meta" else torch.zeros(batch, 2)
    return read_actions(kind, nothing, batch, torch.ones_like(over))
