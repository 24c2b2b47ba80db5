"""What is computed for a chunk, for parts of it, and for a row that no worker survives."""

import numpy as np
import pytest

import samplers
from samplers.errors import EvaluationError
from samplers.execution.executors.chunks import Chunk
from samplers.execution.executors.packing import unpack_gradients, unpack_terms
from samplers.execution.executors.problem_work import ProblemWork

X = np.random.default_rng(0).standard_normal((9, 2))


def raising_terms(x):
    if (x[:, 0] > 1.0).any():
        raise ArithmeticError("off the map")
    return 2.0 - x


SERIES = samplers.FunctionProblem(
    dim=2, terms=raising_terms, gradient=lambda x, term: -np.eye(2)[term], gradient_cost=2.5
)


@pytest.mark.parametrize("kind", ["f", "terms", "gradient"])
def test_a_chunk_is_its_rows(kind):
    work = ProblemWork(SERIES, 0.0, "bound")
    whole = Chunk(kind, (X,) if kind != "gradient" else (X, np.arange(9) % 2, np.zeros(9, dtype=np.int64)))
    numbers, notes = work(whole)
    joined, further = work.join([(row, work(row)) for row in whole.split(1)])
    np.testing.assert_array_equal(joined, numbers)
    assert {name: value for name, value in notes.items() if name != "n_retried"}.items() <= further.items()
    assert (notes["n_retried"] > 0) == (kind != "gradient")


def test_a_lost_row_has_no_outcome_or_ends_the_run():
    row = Chunk("f", (X[:1],))
    work = ProblemWork(SERIES, 0.0, "failure")
    f, notes = work.lose(row, "killed")
    assert np.isnan(f).all()
    assert notes == {"n_retried": 0, "lost": ["killed"]}
    numbers, notes = work.lose(Chunk("terms", (X[:1],)), "killed")
    assert np.isnan(unpack_terms(numbers, notes, 1).f).all()
    assert (notes["n_terms"], notes["lost"]) == (0, ["killed"])
    numbers, notes = work.lose(Chunk("gradient", (X[:1], np.zeros(1), np.zeros(1))), "killed")
    gradients = unpack_gradients(numbers, notes, 1)
    assert gradients.cost == 2.5
    assert np.isnan(gradients.values).all()
    with pytest.raises(EvaluationError, match=r"no outcome for row 0 .* killed"):
        ProblemWork(SERIES, 0.0, "raise").lose(row, "killed")


def test_chunks_are_named_by_points_and_kind():
    work = ProblemWork(SERIES, 0.0, "raise")
    names = {work.digest(Chunk(kind, (x,))) for kind in ("f", "terms") for x in (X, X[:3], X[3:6])}
    assert len(names) == 6
