"""Lines on standard error that say how far a fit has come."""

import time
from collections.abc import Callable

import typer

SECONDS_BETWEEN = 5.0
"""A count is printed when the line before it is this old [s], so that a short fit prints few lines."""


class FitProgress:
    """Prints what a fit is doing, and its counts every few seconds.

    Args:
        clock: Gives the time [s].

    Example:
        >>> now = iter([0.0, 1.0, 9.0, 9.0])
        >>> progress = FitProgress(clock=lambda: next(now))
        >>> progress.say("cut_in: 40 events")  # on standard error, as what follows
        >>> progress.count("cut_in: refit 1 of 30")  # one second later: not printed
        >>> progress.count("cut_in: refit 2 of 30")
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Begin with nothing printed."""
        self._clock = clock
        self._printed = 0.0

    def say(self, text: str) -> None:
        """Print a line."""
        self._printed = self._clock()
        typer.echo(text, err=True)

    def count(self, text: str) -> None:
        """Print a line if the one before it is not too young."""
        if self._clock() - self._printed >= SECONDS_BETWEEN:
            self.say(text)

    def counter(self, name: str) -> Callable[[str], None]:
        """Return `count` for what has a name, which begins its lines."""
        return lambda text: self.count(f"{name}: {text}")


def ignore_progress(_: str) -> None:
    """Take a line of progress and print nothing."""
