"""Table of all simulations of a run: a draft grows while it runs, and becomes episodes.parquet when it is done.

What a simulation weighs in p is known only at the end. So each batch goes into the draft, a stream of Arrow's, and the
draft is read once more, part by part, when the run is done. Neither step holds many more than `ROWS_AT_ONCE`
simulations, or `BYTES_AT_ONCE` of them where they are large.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple, cast

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import replace_file
from rare_envs.study.run_folder import EPISODES
from samplers.evaluate import Simulated
from samplers.problem import FloatArray
from samplers.result import Estimate
from samplers.sample import SimulationRows

MAX_SHOWN = 12
"""Blocks of more values than this, drivers' weights and noise, are summarised instead of shown."""
ORDINARY_DRAWS = 4000
"""Scenarios drawn from the traffic model to show what is ordinary."""
LONGEST_KEY = 64
"""Bytes of a scenario that are its own digest."""


class Column(NamedTuple):
    """One column of x."""

    name: str
    """The parameter's name; in a block with the number in it, such as "speed[0]"."""
    unit: str
    shown: bool
    """Whether the block is small enough to show its values."""

    @property
    def label(self) -> str:
        """Name and unit, for an axis."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


def list_columns(space: ScenarioSpace) -> list[Column]:
    """Return the columns in the order of x."""
    blocks = zip(space.units, space.sizes, strict=True)
    about = [(unit, size <= MAX_SHOWN) for unit, size in blocks for _ in range(size)]
    return [Column(name, unit, shown) for name, (unit, shown) in zip(space.column_names, about, strict=True)]


def draw_ordinary(space: ScenarioSpace) -> FloatArray:
    """Return ordinary scenarios (n, d), the same on the console, in pictures and in the report."""
    return space.sample(ORDINARY_DRAWS, np.random.default_rng(0))


def find_ordinary_range(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the ends between which nine of ten ordinary values lie, of each column of (n, k)."""
    low, high = np.quantile(values, (0.05, 0.95), axis=0)
    return low, high


def format_value(value: float, places: int = 2) -> str:
    """Return a value with `places` decimals, or with two digits where these would be zeros (fog is 1e-4 per metre)."""
    return f"{value:.2g}" if 0.0 < abs(value) < 10.0**-places else f"{value:.{places}f}"


def digest_scenarios(x: NDArray[Any]) -> list[bytes]:
    """Return the digest of each of some scenarios x (n, d), in single precision, in which they are simulated."""
    rows = np.ascontiguousarray(x, dtype=np.float32)
    keys: list[bytes] = rows.view(f"V{4 * rows.shape[1]}").ravel().tolist()
    if 4 * rows.shape[1] <= LONGEST_KEY:
        return keys
    return [hashlib.blake2b(key, digest_size=16).digest() for key in keys]


EPISODE_FORMAT = 1
"""Version of the columns, in the metadata of the file; see docs/using_results.md."""
ROWS_AT_ONCE, BYTES_AT_ONCE = 2**16, 2**25
"""Simulations of a row group, at most so many and so large."""
BEFORE_X = {"simulation": pa.int64(), "run": pa.int32(), "stage": pa.int32()}
BEHIND_X = {
    "f": pa.float64(),
    "failed": pa.bool_(),
    "log_weight": pa.float64(),
    "crash": pa.string(),
    "error": pa.string(),
    "seconds": pa.float32(),
}
DRAFTED = ("f", "error", "seconds")
"""Columns beside x that are known while the run goes on."""


def name_columns(space: ScenarioSpace) -> dict[str, pa.DataType]:
    """Return the columns of x and their types: numbers by name, and blocks of many values as lists."""
    types: dict[str, pa.DataType] = {}
    for name, size in zip(space.names, space.sizes, strict=True):
        if size > MAX_SHOWN:  # in single precision, in which they are simulated
            types[name] = pa.list_(pa.float32(), size)
        else:
            types |= dict.fromkeys([name] if size == 1 else [f"{name}[{k}]" for k in range(size)], pa.float64())
    own = {*BEFORE_X, *BEHIND_X}
    return {f"x.{name}" if name in own else name: kind for name, kind in types.items()}


class EpisodeTable:
    """The table of a run. It is no part of the answer: where it cannot be written, the run goes on without it."""

    def __init__(self, folder: Path | None, space: ScenarioSpace) -> None:
        self.lost = ""
        self._folder, self._columns, self._file = folder, name_columns(space), cast(Any, None)
        self._rows = max(min(ROWS_AT_ONCE, BYTES_AT_ONCE // (8 * max(sum(space.sizes), 1))), 1)
        if folder is not None:
            with self._giving_up():
                self._file = TemporaryFile(dir=folder)
                self._schema = pa.schema([*self._columns.items(), *((name, BEHIND_X[name]) for name in DRAFTED)])
                self._writer = pa.ipc.new_stream(self._file, self._schema)

    def add(self, seen: Simulated) -> None:
        """Add simulations to the draft."""
        if self._file is not None:
            errors = np.full(len(seen.f), None, dtype=object)
            errors[np.isnan(seen.f)] = seen.reasons
            own = {"f": seen.f, "error": errors, "seconds": seen.seconds.astype(np.float32)}
            arrays = [*self._split(seen.x), *(pa.array(own[name], BEHIND_X[name]) for name in DRAFTED)]
            with self._giving_up():
                self._writer.write_batch(pa.record_batch(arrays, schema=self._schema))

    def write(self, estimate: Estimate, crashes: Mapping[bytes, str]) -> None:
        """Write the table of a run that is done; kinds of crash of its failures are by `digest_scenarios`."""
        if self._file is None or self._folder is None:
            return
        fields = [*BEFORE_X.items(), *self._columns.items(), *BEHIND_X.items()]
        schema = pa.schema(fields, metadata={"rare_envs.format": str(EPISODE_FORMAT)})
        with self._giving_up():
            self._writer.close()
            self._file.seek(0)
            self._folder.mkdir(parents=True, exist_ok=True)  # somebody may have removed it
            with (
                replace_file(self._folder / EPISODES) as path,
                path.open("wb") as opened,  # Arrow takes names in UTF-8 only
                pq.ParquetWriter(opened, schema, compression="zstd") as file,
                pa.ipc.open_stream(self._file) as draft,
            ):
                first = 0
                for part in _join_batches(draft, self._rows):
                    known = self._describe(part, estimate, first, crashes)
                    columns = [known[name] if name in known else part[name] for name in schema.names]
                    file.write_table(pa.table(columns, schema=schema), row_group_size=self._rows)
                    first += part.num_rows

    def close(self) -> None:
        """Drop the draft: after an interruption the journal has what is needed to make it again."""
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
            self._file = None

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        """Go on without a table after an error of the disk."""
        try:
            yield
        except OSError as error:
            self.lost = f"{EPISODES} could not be written: {error.strerror or error}"
            self.close()

    def _split(self, x: FloatArray) -> Iterator[Any]:
        """Yield the columns of x (n, d) as Arrow's."""
        ends = np.cumsum([getattr(kind, "list_size", 1) for kind in self._columns.values()])
        for kind, part in zip(self._columns.values(), np.split(x, ends[:-1], axis=1), strict=True):
            if hasattr(kind, "list_size"):
                values = pa.array(np.ascontiguousarray(part, dtype=np.float32).ravel())
                yield pa.FixedSizeListArray.from_arrays(values, kind.list_size)
            else:
                yield pa.array(part[:, 0], kind)

    def _describe(self, part: pa.Table, estimate: Estimate, first: int, crashes: Mapping[bytes, str]) -> dict[str, Any]:
        """Return the columns of simulations from number `first` on that are known at the end."""
        n, f = part.num_rows, part["f"].to_numpy()
        about, failed = describe_simulations(estimate, first, n), np.isnan(f) | (f <= estimate.gamma)
        found, rows = np.full(n, None, dtype=object), np.flatnonzero(failed)
        if len(rows) and crashes:  # null where a failure was not driven again
            failing = part.take(pa.array(rows)).combine_chunks()
            found[rows] = [crashes.get(digest) for digest in digest_scenarios(_stack(failing, self._columns))]
        return {
            "simulation": pa.array(np.arange(first, first + n)),
            "run": pa.array(about.run, type=pa.int32()),
            "stage": pa.array(about.stage, type=pa.int32(), mask=about.stage < 0),
            "f": pa.array(f, mask=np.isnan(f)),
            "failed": pa.array(failed),
            "log_weight": pa.array(about.log_weight, mask=np.isnan(about.log_weight)),
            "crash": pa.array(found, pa.string()),
        }


def _join_batches(draft: Iterable[pa.RecordBatch], rows: int) -> Iterator[pa.Table]:
    """Yield tables of at least `rows` simulations, and the rest."""
    waiting: list[pa.RecordBatch] = []
    count = 0
    for batch in draft:
        waiting.append(batch)
        count += batch.num_rows
        if count >= rows:
            yield pa.Table.from_batches(waiting)
            waiting, count = [], 0
    if waiting:
        yield pa.Table.from_batches(waiting)


def read_scenarios(table: pa.Table, space: ScenarioSpace) -> NDArray[np.float32]:
    """Return the scenarios x (n, d) of a table of simulations."""
    return _stack(table.combine_chunks(), name_columns(space))


def _stack(table: pa.Table, columns: Iterable[str]) -> NDArray[np.float32]:
    """Return columns of a table, of one chunk each, as an array of shape (n, d)."""
    return np.hstack([_as_array(table[name].chunk(0)) for name in columns])


def _as_array(column: pa.Array) -> NDArray[np.float32]:
    """Return a column of x, numbers or lists, as an array of shape (n, k)."""
    values = column.flatten() if hasattr(column.type, "list_size") else column
    return np.asarray(values.to_numpy(), dtype=np.float32).reshape(len(column), -1)


def describe_simulations(estimate: Estimate, first: int, n: int) -> SimulationRows:
    """Return what simulations were made for, those of the further run under the refits included."""
    further = estimate.ensemble_run
    n_first, n_more = (sum(n for _, n, _ in run.spans) if run is not None else 0 for run in (estimate, further))
    rows = SimulationRows(np.full(n, -1), np.full(n, -1), np.full(n, np.nan))
    inside = max(min(n_first - first, n), 0)
    for whole, part in zip(rows, estimate.describe_simulations(first, inside), strict=True):
        whole[:inside] = part
    start = first + inside - n_first
    rest = max(min(n_more - start, n - inside), 0)
    if further is not None and n_first and rest:  # numbered after the last replicate, without a weight in p
        rows.run[inside : inside + rest] = 1 + max(number for number, _, _ in estimate.spans)
        rows.stage[inside : inside + rest] = further.describe_simulations(start, rest).stage
    return rows
