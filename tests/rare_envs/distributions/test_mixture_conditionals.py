"""Conditionals one by one: shapes, chunks, and the agreement of density, map and draws with those of plain boxes."""

import sys

import numpy as np
import pytest

from rare_envs.distributions import mixture_conditionals
from rare_envs.distributions.coordinates import CoordinateKind, Coordinates
from rare_envs.distributions.mixture_conditionals import CHUNK_ROWS, MixtureConditionals
from rare_envs.distributions.truncated_mixture import TruncatedGaussianMixture

KINDS: tuple[CoordinateKind, ...] = ("plain", "plain")
BOX = Coordinates([-1.0, -1.0], [2.0, 2.0], KINDS, names=("a", "b"), order=("b", "a"))
MEANS = [[0.0, 1.0], [1.0, -1.0]]
COVARIANCES = [[[1.0, 0.5], [0.5, 2.0]], [[0.3, 0.0], [0.0, 0.3]]]
PARTS = ([0.5, 0.5], MEANS, COVARIANCES)


def test_an_order_of_columns_is_the_mixture_with_columns_exchanged() -> None:
    """The mixture's arrays are in the order (b, a); columns of x and u stay where they are."""
    exchanged = MixtureConditionals(BOX, *PARTS)
    plain = TruncatedGaussianMixture(*PARTS, [-1.0, -1.0], [2.0, 2.0])
    u = np.random.default_rng(0).standard_normal((1000, 2))
    x = exchanged.from_standard_normal(u)
    assert (x[:, ::-1] == plain.from_standard_normal(u[:, ::-1])).all()
    assert (exchanged.log_prob(x) == plain.log_prob(x[:, ::-1])).all()
    assert (exchanged.to_standard_normal(x)[:, ::-1] == plain.to_standard_normal(x[:, ::-1])).all()
    same = [each.sample(1000, np.random.default_rng(1)) for each in (exchanged, plain)]
    assert (same[0][:, ::-1] == same[1]).all()


def test_chunks_do_not_show() -> None:
    conditionals = MixtureConditionals(BOX, *PARTS)
    x = conditionals.sample(CHUNK_ROWS + 7, np.random.default_rng(1))
    whole = conditionals.log_prob(x)
    assert (whole[CHUNK_ROWS - 3 :] == conditionals.log_prob(x[CHUNK_ROWS - 3 :])).all()


def test_shapes_and_points_are_checked() -> None:
    with pytest.raises(ValueError, match=r"means of shape \(2, 2\), one for each column, got \(2, 1\)"):
        MixtureConditionals(BOX, [0.5, 0.5], [[0.0], [1.0]], [[[1.0]], [[1.0]]])
    conditionals = MixtureConditionals(BOX, *PARTS)
    with pytest.raises(ValueError, match=r"Expected x of shape \(n, 2\), got \(3, 1\)"):
        conditionals.rows("x", np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"x\[1, 0\] = 5 is outside the box"):
        conditionals.rows_in_box([[0.0, 0.0], [5.0, 0.0]])


@pytest.fixture
def _forget():
    mixture_conditionals._load_compiled.cache_clear()
    yield
    mixture_conditionals._load_compiled.cache_clear()


@pytest.mark.usefixtures("_forget")
def test_compiled_code_that_fails_or_gives_other_values_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = pytest.importorskip("rare_envs.distributions.rows.compiled_rows", reason="numba is not installed")
    assert mixture_conditionals.find_compiled() is rows
    find = rows.find_log_densities

    def shift(*arguments):
        out, fits = find(*arguments)
        return out + 1e-9, fits

    def fail(*arguments):
        raise RuntimeError("no compiler")

    for function in (shift, fail):
        mixture_conditionals._load_compiled.cache_clear()
        monkeypatch.setattr(rows, "find_log_densities", function)
        assert mixture_conditionals.find_compiled() is None


def test_numba_is_not_imported_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    assert mixture_conditionals.find_compiled() is None
    conditionals = MixtureConditionals(BOX, *PARTS)
    x = conditionals.from_standard_normal(np.zeros((3, 2)))
    assert np.isfinite(conditionals.log_prob(x)).all()
    assert "numba" not in sys.modules
