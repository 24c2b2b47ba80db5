"""StoredMethod: the name and settings of a method that a file cannot hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NoReturn


@dataclass(frozen=True)
class StoredMethod:
    """A method of another package in a result that was read from a file; it cannot run.

    Example:
        >>> StoredMethod("lattice", True, {"n": "100"}).steps(None, None, None)
        Traceback (most recent call last):
            ...
        ValueError: The method 'lattice' was read from a file and cannot run; make one of its class.
    """

    name: str
    """Name on the command line."""
    stops_at_target: bool
    """As in `samplers.Stepping`."""
    settings: dict[str, str] = field(default_factory=dict)
    """Settings as text, by name."""

    def steps(self, inputs: Any, goal: Any, rng: Any) -> NoReturn:
        """Raise a ValueError: the code of the method is not known."""
        raise ValueError(f"The method {self.name!r} was read from a file and cannot run; make one of its class.")
