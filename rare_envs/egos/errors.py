"""Errors of egos: an ego that is gone, that does not answer, or that failed on a scenario."""

from __future__ import annotations

from typing import ClassVar


class EgoGone(BaseException):
    """The ego cannot be queried any more, whatever the scenario.

    Like KeyboardInterrupt it is no `Exception`: code that survives failing scenarios must not take it for one.

    Example:
        >>> issubclass(EgoGone, Exception)
        False
    """


class NoAnswer(RuntimeError):
    """The ego has not answered in time, or has died: perhaps because of one of the rows of the query.

    Example:
        >>> reason_of(NoAnswer("no answer within 10 s"))
        'NoAnswer: no answer within 10 s'
    """


class EgoFault(ValueError):
    """The ego has failed on a scenario, twice.

    Example:
        >>> EgoFault("The ego failed twice.").final
        True
    """

    final: ClassVar[bool] = True
    """The ego has been queried again already, so nobody needs to; `samplers` reads this attribute."""


def reason_of(error: BaseException) -> str:
    """Return what went wrong, in one line.

    Example:
        >>> reason_of(RuntimeError("no road"))
        'RuntimeError: no road'
    """
    words = " ".join(str(error).split())
    if isinstance(error, ValueError) and words:  # ours say what is wrong by themselves
        return words
    return f"{type(error).__name__}: {words}" if words and not isinstance(error, SystemExit) else repr(error)
