"""Figures as SVG that stands in a page, or as files."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from rare_envs.files import replace_file
from rare_envs.study.plots import STYLE

WIDE_ON_PHONES = 420
"""Width on a narrow screen of a wide figure that has no form of its own for it [pixels]."""
FORMATS = ("svg", "pdf", "png")
"""Of figures as files."""
Draw = Callable[[Figure], object]
"""Draws into an empty figure."""
Size = tuple[float, float]
"""Width and height [inch]."""


class FigureOfPage:
    """A figure of the page, drawn once for each format that is asked for.

    Args:
        name: A word, which is its name as a file.
        caption: What it shows, in words.
        draw: Draws it.
        size: Width and height [inch].
        narrow: As draw and size, for a narrow screen; None for the same figure, which has to be moved there where it is
            wide.
    """

    def __init__(
        self, name: str, caption: str, draw: Draw, size: Size, narrow: tuple[Draw, Size] | None = None
    ) -> None:
        self.name, self.caption, self._draw, self._size = name, caption, draw, size
        self._narrow = None if narrow is None else FigureOfPage(f"{name}-narrow", caption, *narrow)

    def to_svg(self) -> str:
        """Return it as an element of a page: it has the width of its place, and its text is text.

        Two elements where there is a form for narrow screens, of which the page shows one.
        """
        if self._narrow is None:
            return self._make_svg()
        wide, narrow = self._make_svg(), self._narrow.to_svg()
        return wide.replace("<svg", '<svg class="wide"', 1) + narrow.replace("<svg", '<svg class="narrow"', 1)

    def _make_svg(self) -> str:
        buffer = io.StringIO()
        with matplotlib.rc_context({**STYLE, "svg.fonttype": "none", "svg.hashsalt": self.name}):
            self._make().savefig(buffer, format="svg", metadata={"Date": None})
        text = buffer.getvalue()
        text = re.sub(r"<metadata>.*?</metadata>", "", text[text.index("<svg") :], flags=re.DOTALL)
        text = re.sub(
            r'(<svg[^>]*?) width="[^"]*"', r"\1", re.sub(r'(<svg[^>]*?) height="[^"]*"', r"\1", text, count=1), count=1
        )
        # ids of matplotlib, such as figure_1, are the same in every figure
        text = re.sub(r'\bid="([^"]+)"', rf'id="{self.name}-\1"', text)
        text = re.sub(r'(xlink:href="#|href="#|url\(#)(?=[^)"])', rf"\g<1>{self.name}-", text)
        # no larger than with type of normal size; a phone shows wide ones as large as can be read, and moves them
        size = f"max-width:{110 * self._size[0]:.0f}px;min-width:{WIDE_ON_PHONES if self._size[0] > 7 else 0}px"
        return text.replace("<svg", f'<svg role="img" aria-label="{_escape(self.caption)}" style="{size}"', 1).strip()

    def save(self, folder: Path, kind: str) -> Path:
        """Save it as a file of a folder, and return its path."""
        path = folder / f"{self.name}.{kind}"
        with matplotlib.rc_context(STYLE), replace_file(path) as draft:
            self._make().savefig(draft, dpi=150)
        return path

    def _make(self) -> Figure:
        figure = Figure(figsize=self._size, layout="constrained")
        self._draw(figure)
        return figure


def _escape(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")
