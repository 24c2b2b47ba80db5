"""Table of all simulations of a run: a draft grows while it runs, and becomes episodes.parquet when it is done.

What a simulation weighs in p is known only at the end. So each batch goes into the draft, a stream of Arrow's, and the
draft is read once more, part by part, when the run is done. Neither step holds more than `ROWS_AT_ONCE` simulations,
or `BYTES_AT_ONCE` of them where they are large.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from rare_envs.distributions.space import ScenarioSpace
from rare_envs.files import replace_file
from rare_envs.study.columns import MAX_SHOWN
from samplers.execution.journal import digest_points
from samplers.problem import FloatArray
from samplers.result import Estimate
from samplers.sample import SimulationRows

EPISODE_FORMAT = 1
"""Version of the columns, in the metadata of the file; see docs/run_folder.md."""
ROWS_AT_ONCE, BYTES_AT_ONCE = 2**16, 2**25
"""Simulations of a row group, at most so many and so large."""
OWN_COLUMNS = ("simulation", "run", "stage", "f", "failed", "log_weight", "crash", "error", "seconds")
"""Columns beside the parameters."""


def digest_scenario(x: NDArray[Any]) -> str:
    """Return the digest of a scenario x (d,), in single precision, in which it is simulated."""
    return digest_points(x.astype(np.float32))


class EpisodeBatch(NamedTuple):
    """Simulations that were made together."""

    x: FloatArray
    """Parameters, shape (n, d)."""
    f: FloatArray
    """Shape (n,); NaN where there is no outcome."""
    errors: Sequence[str | None]
    """Reason why there is none, length n."""
    seconds: FloatArray
    """Wall time of each [s], shape (n,)."""


def name_columns(space: ScenarioSpace) -> dict[str, pa.DataType]:
    """Return the columns of x and their types: numbers by name, and blocks of many values as lists.

    Example:
        >>> import rare_envs
        >>> space = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").space
        >>> {name: str(kind) for name, kind in name_columns(space).items()}
        {'ego_speed': 'double', 'lead_speed': 'double', 'gap': 'double'}
    """
    types: dict[str, pa.DataType] = {}
    for name, size in zip(space.names, space.sizes, strict=True):
        if size > MAX_SHOWN:  # in single precision, in which they are simulated
            types[name] = pa.list_(pa.float32(), size)
        else:
            types |= dict.fromkeys([name] if size == 1 else [f"{name}[{k}]" for k in range(size)], pa.float64())
    return {f"x.{name}" if name in OWN_COLUMNS else name: kind for name, kind in types.items()}


class EpisodeDraft:
    """Simulations of a run that goes on, in a file without a name, which is gone when the process is.

    Args:
        folder: On whose disk it lies.
        space: Of x.

    Raises:
        OSError: It cannot be written.
    """

    def __init__(self, folder: Path, space: ScenarioSpace) -> None:
        self.n = 0
        self.columns = name_columns(space)
        self._batches: list[EpisodeBatch] = []
        self._n_waiting = 0
        self._rows = max(min(ROWS_AT_ONCE, BYTES_AT_ONCE // (8 * max(sum(space.sizes), 1))), 1)
        own = {"f": pa.float64(), "error": pa.string(), "seconds": pa.float32()}
        self.schema = pa.schema([*self.columns.items(), *own.items()])
        self._file = TemporaryFile(dir=folder)
        self._writer = pa.ipc.new_stream(self._file, self.schema)

    def add(self, batch: EpisodeBatch) -> None:
        """Add simulations.

        Raises:
            OSError: They cannot be written.
        """
        self._batches.append(batch)
        self.n += len(batch.f)
        self._n_waiting += len(batch.f)
        if self._n_waiting >= self._rows:
            self._flush()

    def read(self) -> Iterator[pa.RecordBatch]:
        """Go through all simulations, part by part; there will be no more of them.

        Raises:
            OSError: The last ones cannot be written.
        """
        self._flush()
        self._writer.close()
        self._file.seek(0)
        with pa.ipc.open_stream(self._file) as reader:
            yield from reader

    def close(self) -> None:
        """Let go of the file."""
        self._batches.clear()
        self._file.close()

    def _flush(self) -> None:
        if not self._n_waiting:
            return
        x = np.concatenate([batch.x for batch in self._batches])
        own = {
            "f": np.concatenate([batch.f for batch in self._batches]),
            "error": pa.array([error for batch in self._batches for error in batch.errors], pa.string()),
            "seconds": np.concatenate([batch.seconds for batch in self._batches]).astype(np.float32),
        }
        self._batches.clear()
        self._n_waiting = 0
        for first in range(0, len(x), self._rows):
            rows = slice(first, first + self._rows)
            self._writer.write_batch(self._encode(x[rows], {name: values[rows] for name, values in own.items()}))

    def _encode(self, x: FloatArray, own: Mapping[str, Any]) -> pa.RecordBatch:
        """Return simulations x (n, d) with their other columns as Arrow's."""
        ends = np.cumsum([kind.list_size if pa.types.is_fixed_size_list(kind) else 1 for kind in self.columns.values()])
        arrays: list[Any] = []
        for kind, part in zip(self.columns.values(), np.split(x, ends[:-1], axis=1), strict=True):
            if pa.types.is_fixed_size_list(kind):
                values = pa.array(np.ascontiguousarray(part, dtype=np.float32).ravel())
                arrays.append(pa.FixedSizeListArray.from_arrays(values, kind.list_size))
            else:
                arrays.append(part[:, 0])
        arrays += own.values()
        parts = [
            pa.array(each, type=field.type) if isinstance(each, np.ndarray) else each
            for each, field in zip(arrays, self.schema, strict=True)
        ]
        return pa.record_batch(parts, schema=self.schema)


def write_episodes(path: Path, draft: EpisodeDraft, estimate: Estimate, crashes: Mapping[str, str]) -> None:
    """Write the table of a run that is done.

    Args:
        path: Of the file.
        draft: All its simulations.
        estimate: Its result.
        crashes: Kinds of crash of failures that were driven again, by `digest_scenario`.

    Raises:
        OSError: It cannot be written.
    """
    schema = pa.schema(
        [
            ("simulation", pa.int64()),
            ("run", pa.int32()),
            ("stage", pa.int32()),
            *draft.columns.items(),
            ("f", pa.float64()),
            ("failed", pa.bool_()),
            ("log_weight", pa.float64()),
            ("crash", pa.string()),
            ("error", pa.string()),
            ("seconds", pa.float32()),
        ],
        metadata={"rare_envs.format": str(EPISODE_FORMAT)},
    )
    with replace_file(path) as file, pq.ParquetWriter(file, schema, compression="zstd") as writer:
        first = 0
        for batch in draft.read():
            about = describe_simulations(estimate, first, batch.num_rows)
            f = batch.column("f").to_numpy()
            failed = np.isnan(f) | (f <= estimate.gamma)
            known = {
                "simulation": pa.array(np.arange(first, first + batch.num_rows)),
                "run": pa.array(about.run, type=pa.int32()),
                "stage": pa.array(about.stage, type=pa.int32(), mask=about.stage < 0),
                "f": pa.array(f, mask=np.isnan(f)),
                "failed": pa.array(failed),
                "log_weight": pa.array(about.log_weight, mask=np.isnan(about.log_weight)),
                "crash": pa.array(_find_crashes(batch, draft.columns, failed, crashes), pa.string()),
            }
            columns = [known[n] if n in known else batch.column(n) for n in schema.names]
            writer.write_batch(pa.record_batch(columns, schema=schema))
            first += batch.num_rows


def describe_simulations(estimate: Estimate, first: int, n: int) -> SimulationRows:
    """Return what simulations were made for, those of the further run under the refits included.

    The further run has the number after the last replicate, and its simulations have no weight in p.
    """
    index, further = estimate.simulations, estimate.ensemble_run
    run, stage, log_weight = np.full(n, -1), np.full(n, -1), np.full(n, np.nan)
    n_first = 0 if index is None else index.n
    inside = max(min(n_first - first, n), 0)
    if index is not None and inside:
        run[:inside], stage[:inside], log_weight[:inside] = index.describe(first, inside)
    more = None if further is None else further.simulations
    start = first + inside - n_first
    rest = 0 if more is None else max(min(more.n - start, n - inside), 0)
    if index is not None and more is not None and rest:
        rows = slice(inside, inside + rest)
        run[rows] = 1 + max(number for number, _, _ in index.spans)
        stage[rows] = more.describe(start, rest).stage
    return SimulationRows(run, stage, log_weight)


def _find_crashes(
    batch: pa.RecordBatch, names: Iterable[str], failed: NDArray[np.bool_], crashes: Mapping[str, str]
) -> list[str | None]:
    """Return the kind of crash of each simulation, None where it was not driven again."""
    found: list[str | None] = [None] * len(failed)
    rows = np.flatnonzero(failed)
    if len(rows) and crashes:
        failing = batch.take(pa.array(rows))
        parts = [_as_table(failing.column(name)) for name in names]
        for row, x in zip(rows, np.hstack(parts), strict=True):
            found[row] = crashes.get(digest_scenario(x))
    return found


def _as_table(column: pa.Array) -> NDArray[np.float32]:
    """Return a column of x, numbers or lists, as an array of shape (n, k)."""
    lists = pa.types.is_fixed_size_list(column.type)
    values: NDArray[np.float32] = (column.flatten() if lists else column).to_numpy().astype(np.float32)
    return values.reshape(len(column), -1)
