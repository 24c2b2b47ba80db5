"""Compiled quantiles have the bits of those by NumPy."""

import numpy as np
import pytest

from rare_envs.distributions.quantiles import mixture_quantile
from tests.rare_envs.distributions.quantiles.random_columns import draw_columns

pytest.importorskip("numba", reason="compiled quantiles need numba")

from rare_envs.distributions.quantiles import compiled_quantile


@pytest.mark.parametrize(("n_plain", "n_log"), [(1, 0), (3, 0), (0, 2), (2, 3), (90, 0)])
def test_the_bits_are_those_of_numpy(n_plain: int, n_log: int) -> None:
    """In 2,000 rows, a hundred of them far out."""
    rng = np.random.default_rng(n_plain)
    column, u = draw_columns(rng, n_plain, n_log, 2000), rng.normal(0.0, 2.0, 2000)
    u[:100] = rng.uniform(-35.0, 35.0, 100)
    for compiled, plain in zip(
        compiled_quantile.search_by_rows(column, u), mixture_quantile.search_quantiles(column, u), strict=True
    ):
        fits = mixture_quantile.search_quantiles(column, u)[1]
        assert np.array_equal(compiled[fits], plain[fits])
    assert (compiled_quantile.search_by_rows(column, u)[1] == fits).all()
    assert 0 < np.count_nonzero(~fits) < 40


def test_rows_that_are_alike_are_given_once() -> None:
    rng = np.random.default_rng(8)
    wide, u = draw_columns(rng, 2, 1, 300), rng.normal(0.0, 3.0, 300)
    once = wide._replace(**{name: getattr(wide, name)[:, :1] for name in ("log_weights", "mean", "scale", "share")})
    many = {name: np.repeat(getattr(once, name), 300, axis=1) for name in ("log_weights", "mean", "scale", "share")}
    for low in (np.full(300, 0.5), wide.low):  # the interval may differ from row to row
        short, long = once._replace(low=low), once._replace(low=low, **many)
        x, _ = compiled_quantile.search_by_rows(short, u)
        assert (x == compiled_quantile.search_by_rows(long, u)[0]).all()
        assert (x == mixture_quantile.search_quantiles(short, u)[0]).all()


def test_arrays_may_have_any_layout_and_be_read_only() -> None:
    rng = np.random.default_rng(9)
    column, u = draw_columns(rng, 2, 2, 50), rng.standard_normal(50)
    x, _ = compiled_quantile.search_by_rows(column, u)
    other = column._replace(mean=np.asfortranarray(column.mean), low=column.low[::-1].copy()[::-1])
    other.mean.setflags(write=False)
    assert (compiled_quantile.search_by_rows(other, np.stack([u, u], axis=1)[:, 0])[0] == x).all()
    assert compiled_quantile.search_by_rows(draw_columns(rng, 1, 1, 0), np.zeros(0))[0].shape == (0,)
