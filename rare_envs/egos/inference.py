"""Asking a policy for the actions of a batch, and finding the rows on which it fails."""

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.actions import read_actions
from rare_envs.egos.faults import EgoGone, NoAnswer, part_size, reason_of
from rare_envs.sensors.kinds import each


class PolicyQuery(NamedTuple):
    """What a policy is asked: B rows."""

    observation: Any
    """Shape (B, ...), or several of that kind by name."""
    hidden: Any
    """Its memory; None at the start, and always if it has none."""
    start: NDArray[np.bool_]
    """Rows that begin an episode, shape (B,)."""
    over: Tensor
    """Rows whose action does not matter, boolean, shape (B,)."""

    def rows(self, part: slice) -> "PolicyQuery":
        """Some of the rows, for a policy without a memory."""
        return PolicyQuery(each(lambda one: one[part], self.observation), None, self.start[part], self.over[part])


def query_policy(policy: Any, kind: str, asked: PolicyQuery, lost: dict[int, str] | None = None) -> tuple[Tensor, Any]:
    """Let a policy act on a batch.

    Args:
        policy: Has Stable-Baselines3's `predict`.
        kind: Of its actions, "continuous" or "meta".
        asked: What it is asked.
        lost: Takes the rows on which it fails, with the reason; they get the action of a row that does not matter.

    Returns:
        What `rare_envs.control.actions.read_actions` makes of its actions, and its memory.

    Raises:
        Exception: It fails and lost is None, or it fails on a batch that cannot be asked in parts because the policy
            has a memory.
    """
    if lost is None:
        try:
            action, hidden = _predict(policy, asked)
        except NoAnswer:  # its connection may have been lost
            action, hidden = _predict(policy, asked)
        return read_actions(kind, action, len(asked.start), asked.over), hidden
    try:
        action, hidden = _predict(policy, asked)
        over = asked.over | _not_finite(action, asked.over, lost)
        return read_actions(kind, action, len(over), over), hidden
    except EgoGone:
        raise
    except (Exception, SystemExit) as error:  # the policy is the user's: anything may happen in it
        found = (
            None if asked.hidden is not None else _isolate_failing_rows(policy, kind, asked, error, len(asked.start))
        )
        if found is None:
            raise
        given, reasons = found
        lost.update(reasons)
        return given, None


def _predict(policy: Any, asked: PolicyQuery) -> tuple[Tensor, Any]:
    action, hidden = policy.predict(
        asked.observation, state=asked.hidden, episode_start=asked.start, deterministic=True
    )
    return torch.as_tensor(np.asarray(action)).to(asked.over.device), hidden


def _not_finite(action: Tensor, over: Tensor, lost: dict[int, str]) -> Tensor:
    """Rows of actions that are not finite, boolean, shape (B,); they are lost."""
    bad = torch.zeros_like(over)
    if action.is_floating_point() and action.ndim == 2 and len(action) == len(over):
        bad = ~torch.isfinite(action).all(dim=1) & ~over
        lost.update(dict.fromkeys(bad.nonzero()[:, 0].tolist(), "NaN or infinite actions"))
    return bad


def _isolate_failing_rows(
    policy: Any, kind: str, asked: PolicyQuery, error: BaseException, whole: int
) -> tuple[Tensor, dict[int, str]] | None:
    """Ask again, after an error, in parts until the rows that fail stand alone.

    Args:
        policy: Is asked.
        kind: Of its actions.
        asked: Rows on which it failed.
        error: How.
        whole: Rows of the batch that they are part of.

    Returns:
        Actions and reasons by row; None if the policy turns out to have a memory.
    """
    rows = len(asked.start)
    if rows == 1 and isinstance(error, NoAnswer):
        return _idle(kind, asked), {0: reason_of(error)}
    size = 1 if rows == 1 else part_size(rows, error, whole)
    parts = [asked.rows(slice(first, first + size)) for first in range(0, rows, size)]
    given: list[Tensor] = []
    reasons: dict[int, str] = {}
    first = 0
    for part in parts:
        mine: dict[int, str] = {}
        try:
            action, hidden = _predict(policy, part)
            over = part.over | _not_finite(action, part.over, mine)
            done = read_actions(kind, action, len(over), over)
            if hidden is not None:
                return None
        except EgoGone:
            raise
        except (Exception, SystemExit) as error:
            if len(part.start) == 1:
                done, mine = _idle(kind, part), {0: reason_of(error)}
            else:
                deeper = _isolate_failing_rows(policy, kind, part, error, whole)
                if deeper is None:
                    return None
                done, mine = deeper
        given.append(done)
        reasons |= {first + row: reason for row, reason in mine.items()}
        first += len(part.start)
    return torch.cat(given), reasons


def _idle(kind: str, asked: PolicyQuery) -> Tensor:
    """The action of rows whose action does not matter."""
    batch, everywhere = len(asked.start), torch.ones_like(asked.over)
    nothing = torch.zeros(batch, dtype=torch.int64) if kind == "meta" else torch.zeros(batch, 2)
    return read_actions(kind, nothing.to(everywhere.device), batch, everywhere)
