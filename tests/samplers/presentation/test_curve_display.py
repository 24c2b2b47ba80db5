import numpy as np
import pytest

import samplers

PROBLEM = samplers.FunctionProblem(lambda x: 3.0 - x[:, 0], dim=2)


@pytest.fixture(scope="module")
def curve():
    return samplers.estimate(PROBLEM, "ce", seed=0, max_sim=5000).curve([1.0, 0.0])


def test_a_curve_comes_back_from_its_file(curve, tmp_path):
    curve.save(tmp_path / "curve")
    found = samplers.Curve.load(tmp_path / "curve")
    for name in ("gammas", "p", "low", "high", "cov", "ess"):
        np.testing.assert_array_equal(getattr(found, name), getattr(curve, name))
    assert str(found) == str(curve)


def test_its_table_has_its_numbers(curve):
    table = curve.to_pandas()
    assert table.gammas.tolist() == [1.0, 0.0]
    np.testing.assert_array_equal(table.p, curve.p)


def test_repr_is_one_short_line(curve):
    assert "\n" not in repr(curve)
    assert len(repr(curve)) <= 120
    assert "0 to 1" in repr(curve)
