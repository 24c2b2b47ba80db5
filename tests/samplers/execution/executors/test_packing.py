"""Terms and gradients come back from numbers and notes as they were, also where some chunk has none."""

import numpy as np
import pytest

from samplers.errors import EvaluationError
from samplers.execution.executors.packing import (
    check_terms,
    make_missing_terms,
    pack_gradients,
    pack_terms,
    unpack_all_terms,
    unpack_gradients,
    unpack_terms,
)
from samplers.problem import TermGradients, Terms


def make_terms(rng, n, n_terms, threshold=0.25):
    values = rng.random((n, n_terms))
    return Terms(values.min(axis=1), values, rng.integers(0, 90, (n, n_terms)), threshold, ("a", "b", "c")[:n_terms])


def test_answers_come_back_as_they_were(rng):
    terms = make_terms(rng, 5, 3)
    terms.f[2] = np.nan
    again = unpack_terms(*pack_terms(terms, {"n_retried": 4}), 5)
    for name in ("f", "values", "ticks", "threshold", "names"):
        np.testing.assert_array_equal(getattr(again, name), getattr(terms, name))
    assert again.ticks.dtype == np.int64
    gradients = TermGradients(rng.random((5, 7)), 12.5)
    back = unpack_gradients(*pack_gradients(gradients, {}), 5)
    np.testing.assert_array_equal(back.values, gradients.values)
    assert back.cost == 12.5


def test_a_chunk_without_terms_gets_as_many_as_the_others_have(rng):
    known, missing = make_terms(rng, 4, 3), make_missing_terms(2, 1, 9.0)
    parts = [(2, pack_terms(missing, {}, 0)), (4, pack_terms(known, {}))]
    whole, n_terms = unpack_all_terms(parts, None)
    assert n_terms == 3
    assert whole.values.shape == (6, 3)
    assert np.isnan(whole.f[:2]).all()
    assert np.isnan(whole.values[:2]).all()
    np.testing.assert_array_equal(whole.values[2:], known.values)
    assert (whole.threshold, whole.names) == (0.25, ("a", "b", "c"))
    nobody, n_terms = unpack_all_terms(parts[:1], 3)
    assert (n_terms, nobody.values.shape) == (3, (2, 3))


def test_another_number_of_terms_is_refused(rng):
    parts = [(4, pack_terms(make_terms(rng, 4, 3), {})), (4, pack_terms(make_terms(rng, 4, 2), {}))]
    with pytest.raises(EvaluationError, match=r"same number of terms in every batch, got \[2, 3\]"):
        unpack_all_terms(parts, None)
    with pytest.raises(EvaluationError, match=r"got \[2, 3\]"):
        unpack_all_terms(parts[:1], 2)
    with pytest.raises(EvaluationError, match=r"shape \(3, J\)"):
        check_terms(Terms(np.zeros(3), np.zeros((3, 0)), np.zeros((3, 0)), 0.0), 3)
