"""Axes to draw in: those that the caller has, the current ones, or those of a file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from typing import TYPE_CHECKING

from samplers.system.optional_libraries import needs_library

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@contextmanager
def drawing_axes(ax: Axes | str | PathLike[str] | None) -> Iterator[Axes]:
    """Yield the axes to draw in; a file is written when the block ends. Needs matplotlib.

    Args:
        ax: Axes; None for the current ones of pyplot; the path of an image, such as "p.png" or "p.pdf", for a figure
            of its own, which pyplot does not know.

    Raises:
        TypeError: If it is something else.
        ValueError: If matplotlib writes no such kind of image.

    Example:
        >>> with drawing_axes(None) as axes:
        ...     _ = axes.set_title("p")
        >>> with drawing_axes(3.0) as axes:
        ...     pass
        Traceback (most recent call last):
            ...
        TypeError: Expected axes of matplotlib or the path of an image, such as "p.png", got float.
    """
    if ax is None:
        with needs_library("matplotlib", "A drawing"):
            from matplotlib import pyplot

        yield pyplot.gca()
    elif isinstance(ax, str | PathLike):
        with needs_library("matplotlib", "A drawing"):
            from matplotlib.figure import Figure

        figure = Figure(layout="constrained")
        yield figure.add_subplot()
        figure.savefig(ax)
    elif hasattr(ax, "errorbar"):
        yield ax
    else:
        raise TypeError(
            f'Expected axes of matplotlib or the path of an image, such as "p.png", got {type(ax).__name__}.'
        )
