"""Records of the reproductions, alike but for rounding: another SciPy rounds a quantile otherwise."""

from __future__ import annotations

from typing import Any

import pytest

ROUNDING = 1e-9


def assert_same(one: Any, other: Any, place: str = "") -> None:
    """Compare two records; numbers may differ by rounding, everything else may not."""
    if isinstance(one, dict) and isinstance(other, dict):
        assert set(one) == set(other), place
        for name, value in one.items():
            assert_same(value, other[name], f"{place}/{name}")
    elif isinstance(one, list) and isinstance(other, list):
        assert len(one) == len(other), place
        for at, (value, shown) in enumerate(zip(one, other, strict=True)):
            assert_same(value, shown, f"{place}/{at}")
    elif isinstance(one, float) and isinstance(other, float):
        assert one == pytest.approx(other, rel=ROUNDING, nan_ok=True), place
    else:
        assert one == other, place
