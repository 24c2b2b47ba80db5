"""What a check of an ego has found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Status = Literal["pass", "warn", "fail"]


@dataclass(frozen=True)
class Finding:
    """One line of a check's table."""

    check: str
    """What was looked at."""
    status: Status
    found: str
    """What was found."""
    advice: str = ""
    """What to do about it."""
    doubtful: bool = True
    """Whether, as a warning, it makes a number doubtful."""


def passed(check: str, found: str) -> Finding:
    """Nothing to do."""
    return Finding(check, "pass", found)


def warned(check: str, found: str, advice: str, doubtful: bool = True) -> Finding:
    """Something to know; doubtful if a number from this ego may mislead."""
    return Finding(check, "warn", found, advice, doubtful)


def failed(check: str, found: str, advice: str) -> Finding:
    """The ego cannot be used like this."""
    return Finding(check, "fail", found, advice)


def exit_code(findings: list[Finding]) -> int:
    """0: the ego can be used; 2: it cannot; 3: it can, but a number from it is doubtful."""
    if any(finding.status == "fail" for finding in findings):
        return 2
    return 3 if any(finding.status == "warn" and finding.doubtful for finding in findings) else 0
