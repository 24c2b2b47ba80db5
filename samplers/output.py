"""Output: results in words, as values of JSON, in files and as tables, for notebooks and drawings.

Reading a file runs no code. A file (safetensors for arrays, JSON for the rest) holds one object of the classes that
`register_stored` names, with objects of these classes inside. A value is written as JSON writes it; numbers that JSON
has not, arrays, tuples and objects are written as {kind: content} with one of the kinds of `_encode`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import secrets
import stat
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import Enum
from html import escape
from importlib import import_module
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

import numpy as np
from numpy.typing import NDArray

from samplers.problem import FloatArray, needs_library

if TYPE_CHECKING:
    import pandas
    import pyarrow
    from matplotlib.axes import Axes

FILE_FORMAT = "samplers 1"
"""First word of the metadata; another one is of another version."""
_KEY = "samplers"
MAX_BYTES, MAX_HEADER_BYTES = 2**32, 2**26
"""Bytes of a file that is read, 40 million simulations of twelve numbers, and of what is no array in it."""
_Stored = TypeVar("_Stored")
_CLASSES: dict[str, type] = {}


def to_json_value(value: Any) -> Any:
    """Return value with None for NaN and infinities, dicts for dataclasses, and numbers and lists of Python."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: to_json_value(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    return value


# Files


def register_stored(*classes: type) -> None:
    """Name dataclasses and enumerations that files may hold; a ValueError where another class has the name."""
    for cls in classes:
        if _CLASSES.setdefault(cls.__name__, cls) is not cls:
            raise ValueError(f"Another class named {cls.__name__} is stored in files already.")


def is_stored(value: object) -> bool:
    """Return whether the class of a value is one that files may hold."""
    return _CLASSES.get(type(value).__name__) is type(value)


def write_object(path: str | PathLike[str], value: object) -> None:
    """Write an object of a registered class to a file.

    Raises:
        TypeError: If it holds something of a class that is not registered.
        OSError: If the file cannot be written.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    arrays: dict[str, NDArray[Any]] = {}
    text, draft = json.dumps(_encode(value, arrays), allow_nan=False), Path(f"{path}.{secrets.token_hex(8)}.part")
    try:
        save_file(arrays, str(draft), metadata={"format": FILE_FORMAT, _KEY: text})
        with suppress(FileNotFoundError):  # others may do no more with it than with the one before
            draft.chmod(Path(path).lstat().st_mode & draft.stat().st_mode)
        draft.replace(path)  # of a link, which is not followed, as of a file
    except (SafetensorError, OSError) as error:
        raise OSError(f"Cannot write {str(path)!r}: {error}") from error
    finally:
        with suppress(OSError):
            draft.unlink()


def read_object(path: str | PathLike[str], cls: type[_Stored]) -> _Stored:
    """Return the object that a file holds.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged, is no such file, or holds an object of another class; one line.
    """
    from safetensors import SafetensorError, safe_open

    where = repr(str(path))
    if not Path(path).exists():
        raise FileNotFoundError(f"There is no file {where}.")
    try:
        found = os.stat(path)
        if not stat.S_ISREG(found.st_mode):  # a pipe would be waited for
            raise ValueError("it is no ordinary file")
        with open(path, "rb") as raw:
            sizes = found.st_size, int.from_bytes(raw.read(8), "little")
        if sizes[0] > MAX_BYTES or sizes[1] > MAX_HEADER_BYTES:
            raise ValueError(f"it has {sizes[0]:,} bytes and a header of {sizes[1]:,}")
        with safe_open(str(path), framework="np") as file:
            about = file.metadata() or {}
            arrays = {name: file.get_tensor(name) for name in file.keys()}  # not a mapping
        if about.get("format") != FILE_FORMAT:
            raise ValueError(f"expected the format {FILE_FORMAT!r}, got {about.get('format')!r}")
        value = _decode(json.loads(about[_KEY]), arrays)
    except OSError as error:
        raise ValueError(f"Cannot read {where}: {error.strerror or error}.") from error
    except (SafetensorError, ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        words = f"Cannot read {where}, it is damaged, of another version, or no file of a result: {reason}."
        raise ValueError(words) from error
    if not isinstance(value, cls):
        raise ValueError(f"Expected {cls.__name__} in {where}, got {type(value).__name__}.")
    return value


def _encode(value: Any, arrays: dict[str, NDArray[Any]]) -> Any:
    """Return value as JSON has it; its arrays are added to `arrays`."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or (isinstance(value, bool | int | str) and not isinstance(value, Enum)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(value)}
    if isinstance(value, np.ndarray):
        name = f"array{len(arrays)}"
        arrays[name] = np.ascontiguousarray(value)  # safetensors writes the memory as it lies
        return {"array": name}
    if isinstance(value, list | tuple):
        return {"tuple" if isinstance(value, tuple) else "list": [_encode(item, arrays) for item in value]}
    if isinstance(value, Mapping):
        return {"dict": [[_encode(key, arrays), _encode(item, arrays)] for key, item in value.items()]}
    name = type(value).__name__
    if not is_stored(value):
        raise TypeError(f"An object of class {name} cannot be written to a file; to_dict() has plain values.")
    if isinstance(value, Enum):
        return {"enum": [name, value.value]}
    fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.init}  # fields by name
    return {"object": [name, {key: _encode(item, arrays) for key, item in fields.items()}]}


def _decode(data: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Return the value that `_encode` has written."""
    if not isinstance(data, dict):
        return data
    ((kind, content),) = data.items()
    if kind == "float":
        return math.nan if content == "nan" else float(content)  # one object: results are equal to what was saved
    if kind == "array":
        return arrays[content]
    if kind in ("list", "tuple"):
        items = [_decode(item, arrays) for item in content]
        return items if kind == "list" else tuple(items)
    if kind == "dict":
        return {_decode(key, arrays): _decode(item, arrays) for key, item in content}
    if kind not in ("enum", "object"):
        raise ValueError(f"unknown kind of value {kind!r}")
    name, inside = content
    if name not in _CLASSES:
        raise ValueError(f"unknown class {name!r}")
    if kind == "enum":
        return _CLASSES[name](inside)
    return _CLASSES[name](**{key: _decode(item, arrays) for key, item in inside.items()})


@dataclass(frozen=True)
class StoredMethod:
    """A method of another package in a result that was read from a file, its settings as text; it cannot run."""

    name: str
    stops_at_target: bool
    settings: dict[str, str] = field(default_factory=dict)

    def steps(self, inputs: Any, goal: Any, rng: Any) -> NoReturn:
        """Raise a ValueError: the code of the method is not known."""
        raise ValueError(f"The method {self.name!r} was read from a file and cannot run; make one of its class.")


# Tables


def arrow_table(
    columns: dict[str, NDArray[Any]],
    missing: dict[str, NDArray[np.bool_]],
    x: FloatArray,
    rows: NDArray[np.int64],
    names: Sequence[str],
) -> pyarrow.Table:
    """Return n points as an Arrow table: the columns (n,) by name, then one for each coordinate of x.

    `missing` has the rows (n,) of some columns that have no value. x (k, d) are the points known, in these rows (k,),
    and `names` those of their coordinates; none for x1, x2, ...

    Raises:
        ValueError: If names are not d different ones, or one is that of another column.
    """
    with needs_library("pyarrow", "A table"):
        import pyarrow as pa

    dim, n = x.shape[1], len(next(iter(columns.values())))
    chosen = list(names) or [f"x{i + 1}" for i in range(dim)]
    if len(chosen) != dim or len({*chosen, *columns}) != dim + len(columns):
        raise ValueError(
            f"Expected {dim} different names of the columns of x, none of them {', '.join(columns)}; "
            f"got {list(names)!r}."
        )
    unknown = np.ones(n, dtype=bool)
    unknown[rows] = False
    table = {name: pa.array(column, mask=missing.get(name)) for name, column in columns.items()}
    for name, values in zip(chosen, x.T, strict=True):
        column = np.full(n, np.nan)
        column[rows] = values
        table[name] = pa.array(column, mask=unknown)
    return pa.table(table)


# In words

FACTS: Mapping[str, str] = MappingProxyType(
    {
        "p": "{p}{odds}; {sure} interval {low} to {high}",
        "p without a lower limit": "{p}{odds}; below {high} ({sure}), no lower limit",
        "p without limits": "{p}{odds}; no lower or upper limit ({sure})",
        "nothing failed": "none in {n} simulations; below {high} ({sure})",
        "failures of the search alone": "none counts in p, {found} found in the search; below {high} ({sure})",
        "status converged": "converged",
        "status no_hits": "no failure found",
        "status budget": "not converged, more simulations (max_sim) are needed",
        "status stopped": "stopped early",
        "status stalled": "the search came no closer to failures",
        "limited by simulations": "{n} simulations; more of them (max_sim) help{few}",
        "limited by events": "{events}; more recordings help, more simulations do not{exact}",
        "limited by both": "{events} ({share}) and {n} simulations ({rest}); more of both help{few}{exact}",
        "too few failures": "; stratum {name}: too few failures found, below {high}",
        "too few events": "too few recorded events for {what}",
        "no failure in a scenario": "{name}: no failure found, adds up to {high} (more simulations help)",
        "no lower limit": "{name}: no lower limit, adds up to {high} (more simulations or recordings help)",
        "if the model is exact": "; {low} to {high} if the {model} is exact",
        "with an exact model": " if the {model} is exact",
        "error not known": "error of the {model} ({reason})",
        "may miss": "failure modes rarer than {unseen} ({sure}) that the search did not find",
        "may miss anything": "failure modes of any probability that the search did not find",
        "warnings": "{first} ({more} more)",
        "next": "{command} ({what})",
        "details": "method, relative error, all intervals, remarks",
        "report": "crash clips, parameters, all intervals",
        "rate": "{rate}; people in {noun} {people}",
        "rate of all": "{rate}; people in the same events {people}",
        "rate of one": "{noun} {rate}; people {people}; human driver model {model}",
        "serious injuries": "{rate}, serious (MAIS 3+)",
        "calibrated": "human driver model {model}, within a factor of {factor} of people's interval",
        "calibrated in": "calibrated in {nouns}: human model within a factor of {factor} of people",
        "not calibrated": "not calibrated: human driver model {model}, {far}",
        "not measured": "not calibrated: human driver model not measured in {traffic}",
        "crash": "{contact}, {speed} m/s relative, delta-v {delta_v} m/s",
        "avoids": "{driver} avoids {share} of these",
        "likeliest": "{kinds}; most likely: {what}",
        "usual": "all parameters in their usual range",
        "unusual": "{name} {value} {unit} (usually {low} to {high})",
        "ratio": "{a} {fails} {ratio} times as often as {b}; {sure} interval {low} to {high}",
        "ratio without limits": "{a} {fails} {ratio} times as often as {b}; no lower or upper limit ({sure})",
        "ratio above": "{a} {fails} more than {low} times as often as {b} ({sure}); no upper limit",
        "ratio below": "{a} {fails} {ratio} times as often as {b}; below {high} ({sure}), no lower limit",
        "ratio of a safe one": "{a} {fails} less than {high} times as often as {b} ({sure}); no failure of {a} found",
        "ratio to a safe one": "{a} {fails} more than {low} times as often as {b} ({sure}); no failure of {b} found",
        "ratio not known": "not known: no failure of {a} or {b} found",
        "undecided which": ": undecided which one {fails} more often",
        "avoided": "{b} avoids {share} of the crashes of {a}: {kinds}",
        "near below": "found + near-crashes below crashes, which they include: more simulations help",
        "above people": "{name} crashes {times} times as often as people in these events",
        "side": "{p}{odds}; {low} to {high}{exact}",
        "side without a failure": "no failure found; below {high}{exact}",
        "shares": "both {both}, only {a} {first}, only {b} {second}",
        "passes": "{what} below {limit} ({sure} confidence, upper limit {high})",
        "fails": "{what} above {limit} ({sure} confidence, lower limit {low})",
        "undecided": "{what} {low} to {high} ({sure} confidence), limit {limit}",
        "more simulations": "more simulations are needed",
        "more events": "more recordings are needed, not simulations",
        "if exact": "it {decision} if the base distribution is exact",
        "gate": "GATE {decision} (exit code {code}): {why}",
    }
)
"""The wording of each fact of an answer, on the terminal, in notebooks, in reports and as `text` in JSON."""
WIDTH, LABEL, MOST_LINES = 98, 13, 12
"""Columns of an answer, those of the names of its facts, and lines."""
LARGE, SMALL, PLAIN = 99.5, 1e-4, 0.1
"""Numbers from which on whole ones are shown; below which powers of ten, in others of the group too unless one of them
reaches the last."""
Row = tuple[str, str]
"""A fact of an answer: its name, and its text."""


def say(fact: str, **values: object) -> str:
    """Return a fact of `FACTS` with its values."""
    return FACTS[fact].format(**values)


def fold_rows(rows: Sequence[Row], most: int = MOST_LINES) -> list[str]:
    """Return facts as lines, at most so many: the longest texts are cut behind a clause, and end with "...".

    A word that is longer than a line is not broken, nor a command whose spaces are no-break ones, for pasting.
    """
    label = max([LABEL, *(len(name) + 2 for name, _ in rows)])
    width = WIDTH - label
    texts = [re.sub("[ \n]+", " ", text) for _, text in rows]
    folded = [_wrap(text, width) for text in texts]
    while sum(map(len, folded)) > most and max(map(len, folded)) > 1:
        number = max(reversed(range(len(rows))), key=lambda each: len(folded[each]))
        folded[number] = _wrap(_cut(texts[number], " ".join(folded[number][:-1])), width)
    return [
        f"{'' if number else name:<{label}}{line}".replace("\xa0", " ")
        for (name, _), lines in zip(rows, folded, strict=True)
        for number, line in enumerate(lines)
    ]


def _wrap(text: str, width: int) -> list[str]:
    """Return a text as lines; words are not broken."""
    return textwrap.wrap(text, width, break_long_words=False, break_on_hyphens=False)


def _cut(text: str, start: str) -> str:
    """Return a text up to the end of a clause in the second half of its start, or else of a word, outside brackets."""
    ends = [
        found.start()
        for found in re.finditer(" ", text[: len(start) - 3])
        if text.count("(", 0, found.start()) == text.count(")", 0, found.start())
    ]
    clauses = [end for end in ends if text[end - 1] in ";,." and 2 * end > len(start)]
    words = [end for end in ends if not text[end - 1].isdigit()]
    return f"{text[: max(clauses or words or ends or [0])].rstrip(';,.')} ..."


def unfold_rows(lines: Sequence[str]) -> list[Row]:
    """Return the facts of which `fold_rows` made these lines."""
    rows: list[Row] = []
    for line in lines:
        name, _, text = line.partition("  ")
        if not name and rows:
            rows[-1] = (rows[-1][0], f"{rows[-1][1]} {text.strip()}")
        else:
            rows.append((name, text.strip()))
    return rows


def format_alike(*values: float) -> list[str]:
    """Return numbers with two digits, as decimals; small ones, and what stands with them, with powers of ten."""
    sizes = [value for value in values if value > 0 and math.isfinite(value)]
    decimal = min(sizes, default=1.0) >= SMALL or max(sizes) >= PLAIN

    def write(value: float) -> str:
        if value <= 0 or not math.isfinite(value):
            return f"{value:g}"
        if value < SMALL or not decimal:
            return f"{value:.1e}"
        if value >= LARGE:
            return f"{round(value, 1 - math.floor(math.log10(value))):,.0f}"
        return f"{value:#.2g}".rstrip(".")

    return [write(value) for value in values]


# For people


class Kept:
    """What results have in common: notebooks show their text; they become tables, and files that run no code."""

    to_arrow: Callable[..., pyarrow.Table]

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"

    def to_pandas(self, names: Sequence[str] = ()) -> pandas.DataFrame:
        """Return `to_arrow` as a pandas table; needs pandas."""
        with needs_library("pandas", "A pandas table"):  # PyArrow's own message names no command
            import_module("pandas")
        return (self.to_arrow(names) if names else self.to_arrow()).to_pandas()

    def _as_stored(self) -> object:
        """Return what a file holds."""
        return self

    def save(self, path: str | PathLike[str]) -> None:
        """Write this to a file that `load` reads, of the format safetensors; an OSError if it cannot be written."""
        write_object(path, self._as_stored())

    @classmethod
    def load(cls: type[_Stored], path: str | PathLike[str]) -> _Stored:
        """Return what `save` has written.

        Raises:
            FileNotFoundError: If there is no such file.
            ValueError: If the file is damaged, or of something else.
        """
        return read_object(path, cls)


@contextmanager
def drawing_axes(ax: Axes | str | PathLike[str] | None) -> Iterator[Axes]:
    """Yield the axes to draw in; a file is written when the block ends. Needs matplotlib.

    Raises:
        TypeError: If it is something else.
        ValueError: If matplotlib writes no such kind of image.
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


def indent_lines(value: object | None) -> list[str]:
    """Return the lines of a value as text, each indented by two spaces; none for None."""
    return [] if value is None else [f"  {line}" for line in str(value).splitlines()]
