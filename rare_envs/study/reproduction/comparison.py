"""Comparison of what a paper prints with what this package finds, as plain values of a record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, kw_only=True)
class ComparedValue:
    """One number of a paper's table beside ours.

    Example:
        >>> value = ComparedValue(labels=("SS", "IDM"), quantity="mean of p", paper=8.0e-4, ours=8.4e-4)
        >>> f"{value.difference:+.0%}"
        '+5%'
    """

    labels: tuple[str, ...]
    """Row of the table: the method, the system under test and so on."""
    quantity: str
    paper: float | None = None
    """As printed; None where the paper has none."""
    ours: float | None = None
    interval: tuple[float, float] | None = None
    """95 % interval of ours."""
    paper_all_in: float | None = None
    """The paper's number with every simulation counted, the search among them; None where that is not known."""
    ours_all_in: float | None = None
    """Ours likewise."""
    released: str = ""
    """What the released code does or gives, in words."""
    reasons: tuple[str, ...] = ()
    """Why the two differ: names of explanations of the table."""

    @property
    def difference(self) -> float | None:
        """Ours over the paper's, less 1; None where one of them is not known, or negative."""
        if self.ours is None or not self.paper or min(self.ours, self.paper) < 0.0:
            return None
        return self.ours / self.paper - 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the value and the difference as a record has them."""
        return {**asdict(self), "difference": self.difference}


@dataclass(frozen=True, kw_only=True)
class MeasuredRow:
    """Numbers of ours in a row of their own, where the paper has nothing to stand beside them."""

    labels: tuple[str, ...]
    values: Mapping[str, float | None]
    """By quantity; the same quantities in every row of a table."""


@dataclass(frozen=True, kw_only=True)
class ComparisonTable:
    """A table of a paper beside ours."""

    name: str
    """A word, unique in the record: `table2`."""
    title: str
    keys: tuple[str, ...]
    """Heads of the columns of the labels."""
    values: tuple[ComparedValue, ...]
    explanations: Mapping[str, str] = field(default_factory=dict)
    """Sentences by the names that the values have as reasons."""
    measured: tuple[MeasuredRow, ...] = ()
    """Further rows of ours, shown below."""
    measured_title: str = ""
    all_in_title: str = "all simulations"
    """Of the columns with every simulation counted."""

    def __post_init__(self) -> None:
        for labels in (*(value.labels for value in self.values), *(row.labels for row in self.measured)):
            if len(labels) != len(self.keys):
                raise ValueError(f"Expected {len(self.keys)} labels ({', '.join(self.keys)}), got {labels}.")
        for value in self.values:
            unknown = [reason for reason in value.reasons if reason not in self.explanations]
            if unknown:
                raise ValueError(f"No explanation {unknown[0]!r} in the table; known: {', '.join(self.explanations)}.")

    def to_dict(self) -> dict[str, Any]:
        """Return the table as a record has it."""
        return {
            "name": self.name,
            "title": self.title,
            "keys": list(self.keys),
            "values": [value.to_dict() for value in self.values],
            "explanations": dict(self.explanations),
            "all_in_title": self.all_in_title,
            "measured_title": self.measured_title,
            "measured": [{"labels": row.labels, "values": dict(row.values)} for row in self.measured],
        }


@dataclass(frozen=True, kw_only=True)
class TestedClaim:
    """A statement of a paper, and the test statistic that says whether it is so here.

    Example:
        >>> finding = TestedClaim(claim="A needs fewer runs than B", statistic="runs of B / runs of A",
        ...                   value=2.1, interval=(1.8, 2.4), verdict="holds")
        >>> finding.to_dict()["verdict"]
        'holds'
    """

    claim: str
    statistic: str
    """What is computed, in words."""
    value: float | None
    interval: tuple[float, float] | None
    """95 % interval of the statistic."""
    verdict: str
    """In a few words: holds, does not hold here, cannot be told."""

    def to_dict(self) -> dict[str, Any]:
        """Return the finding as a record has it."""
        return asdict(self)
