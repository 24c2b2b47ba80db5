"""Which code finds quantiles: the compiled one only where it is at hand and gives the same bits."""

import sys

import numpy as np
import pytest

from rare_envs.distributions.quantiles import column_quantiles, mixture_quantile
from tests.rare_envs.distributions.quantiles.random_columns import draw_columns

COLUMN, U = draw_columns(np.random.default_rng(0), 2, 1, 30), np.random.default_rng(1).standard_normal(30)


@pytest.fixture(autouse=True)
def forget():
    column_quantiles._find_compiled.cache_clear()
    yield
    column_quantiles._find_compiled.cache_clear()


def test_numba_is_used_where_this_process_has_it() -> None:
    pytest.importorskip("numba", reason="compiled quantiles need numba")
    compiled = column_quantiles._find_compiled()
    assert compiled is not None
    assert compiled.__module__.endswith("compiled_quantile")
    x, fits = column_quantiles.find_quantiles(COLUMN, U)
    assert fits.all()
    assert (x == mixture_quantile.search_quantiles(COLUMN, U)[0]).all()


def test_numba_is_not_imported_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "numba", raising=False)
    column_quantiles.find_quantiles(COLUMN, U)
    assert "numba" not in sys.modules


def test_compiled_code_that_fails_or_gives_other_bits_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = pytest.importorskip(
        "rare_envs.distributions.quantiles.compiled_quantile", reason="numba is not installed"
    )

    def round_off(column, u):
        x, fits = mixture_quantile.search_quantiles(column, u)
        return np.nextafter(x, np.inf), fits

    def fail(column, u):
        raise RuntimeError("no compiler")

    for function in (round_off, fail):
        column_quantiles._find_compiled.cache_clear()
        monkeypatch.setattr(compiled, "search_by_rows", function)
        assert column_quantiles._find_compiled() is None
        x, _ = column_quantiles.find_quantiles(COLUMN, U)
        assert (x == mixture_quantile.search_quantiles(COLUMN, U)[0]).all()
