"""Printed numbers: the column COV is a square, and IS there reduces no variance."""

from __future__ import annotations

import pytest

from benchmarks.papers.tian2024.printed import EXPLANATIONS, PRINTED, PrintedRow


@pytest.mark.parametrize("system", ["stack", "IDM"])
@pytest.mark.parametrize("method", ["MCS", "IS"])
def test_the_printed_column_is_the_square_of_plain_monte_carlo(system: str, method: str) -> None:
    row = PRINTED["car-following", system, method]
    assert row.p is not None
    assert row.n_sim is not None
    square = (1 - row.p) / (row.p * row.n_sim)
    assert row.squared_cov == pytest.approx(square, rel=0.25)
    assert row.cov is not None
    assert not row.cov == pytest.approx(square, rel=0.5)


def test_the_explanation_has_the_numbers_of_plain_monte_carlo() -> None:
    """They are near what is printed, and not equal to the digits shown."""
    for system, method in (("stack", "MCS"), ("IDM", "MCS"), ("stack", "IS"), ("IDM", "IS")):
        row = PRINTED["car-following", system, method]
        assert f"{(1 - row.p) / (row.p * row.n_sim):.4f}" in EXPLANATIONS["squared"]
        assert f"{row.squared_cov:.3f}" in EXPLANATIONS["squared"]


def test_root_error_and_gain() -> None:
    row = PRINTED["car-following", "stack", "SS"]
    assert row.cov == pytest.approx(0.4615, abs=1e-4)
    assert row.error == pytest.approx(0.017, abs=5e-4)
    assert row.gain == pytest.approx((1 / 2.392e-4 - 1) / 4980 / (0.213 * 0.98286**2 + 0.01714**2), rel=1e-3)
    assert PRINTED["car-following", "stack", "IS"].error == pytest.approx(0.158, abs=5e-4)
    assert PrintedRow().gain is None
    assert PrintedRow().cov is None
