"""Seeding: the global random generators of a chunk, by the seed of the run and the index of the chunk.

A simulation is to draw nothing itself. One that does (a policy that samples its actions) draws the same again when its
chunk is computed again, on whichever worker, as long as it uses the generators of `random`, `numpy.random` or, on the
CPU, torch.
"""

from __future__ import annotations

import random
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from samplers.execution.executors.base import Work
from samplers.execution.executors.chunks import Chunk, Index, Packed


@dataclass(frozen=True)
class SeededWork:
    """Work with the generators of its chunk.

    Attributes:
        work: Computes a chunk.
        seed: Of the run.
    """

    work: Work
    seed: int

    def __call__(self, index: Index, chunk: Chunk) -> Packed:
        """Compute a chunk; the generators are then as before.

        A chunk that imports torch, and draws by its generator before that could be seeded, is computed once more.
        """
        torch_is_new = "torch" not in sys.modules
        with seed_generators(self.seed, index):
            result = self.work(chunk)
        if not (torch_is_new and _torch_has_drawn()):
            return result
        with seed_generators(self.seed, index):
            return self.work(chunk)


def _torch_has_drawn() -> bool:
    """Return whether torch's generator, which begins in each process with a seed of its own, has left its beginning."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        return False
    fresh = torch.Generator().manual_seed(torch.initial_seed())
    return not torch.equal(fresh.get_state(), torch.random.get_rng_state())


@contextmanager
def seed_generators(seed: int, index: Index) -> Iterator[None]:
    """Let the global generators begin anew for the length of a block.

    Args:
        seed: Of the run.
        index: Of the chunk.

    Example:
        >>> with seed_generators(1, (7,)):
        ...     first = np.random.random()
        >>> with seed_generators(1, (7,)):
        ...     np.random.random() == first
        True
    """
    state = int(np.random.SeedSequence(seed, spawn_key=index).generate_state(1)[0])
    torch: Any = sys.modules.get("torch")  # not imported for this
    before = random.getstate(), np.random.get_state(), None if torch is None else torch.random.get_rng_state()  # noqa: NPY002
    random.seed(state)
    np.random.seed(state)  # noqa: NPY002  (the global generator, which foreign code uses)
    if torch is not None:
        torch.random.default_generator.manual_seed(state)
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002
        if torch is not None:
            torch.random.set_rng_state(before[2])
