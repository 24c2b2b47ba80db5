"""Chunks keep the rows of a request in their order, and their size is the problem's alone."""

import numpy as np
import pytest

import samplers
from samplers.execution.executors.chunks import CHUNK_SIZE, Chunk, find_chunk_size, join_notes


@pytest.mark.parametrize("size", [1, 3, 7, 10, 11, None])
def test_parts_are_the_whole_in_order(size):
    chunk = Chunk("gradient", (np.arange(20.0).reshape(10, 2), np.arange(10), np.arange(10) * 2))
    parts = chunk.split(size)
    assert [len(part) for part in parts[:-1]] == [size] * (len(parts) - 1)
    for array, pieces in zip(chunk.arrays, zip(*(part.arrays for part in parts), strict=True), strict=True):
        np.testing.assert_array_equal(np.concatenate(pieces), array)
    assert len(Chunk("f", (np.empty((0, 2)),)).split(4)) == 1


def test_the_problem_says_how_large_they_are():
    def f(x):
        return x[..., 0]

    assert find_chunk_size(samplers.FunctionProblem(f, 2)) == CHUNK_SIZE
    assert find_chunk_size(samplers.FunctionProblem(f, 2, vectorized=False)) == 1
    assert find_chunk_size(samplers.FunctionProblem(f, 2, vectorized=False, chunk_size=9)) == 9
    assert find_chunk_size(object()) == CHUNK_SIZE
    with pytest.raises(ValueError, match="chunk_size"):
        samplers.FunctionProblem(f, 2, chunk_size=0)


def test_notes_are_added_and_lists_joined():
    parts = [
        {"n_retried": 1, "lost": ["a"], "name": "x"},
        {"n_retried": 2, "name": "y"},
        {"n_retried": 0, "lost": ["b"]},
    ]
    assert join_notes(parts) == {"n_retried": 3, "lost": ["a", "b"], "name": "x"}
