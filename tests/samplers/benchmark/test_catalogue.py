"""The problems of the benchmark as such."""

import numpy as np
import pytest

from samplers.benchmark.analytic_states import random_rotation
from samplers.benchmark.catalogue import PROBLEMS

NOT_RARE = {"rp55_d2", "r_minus_s_d2"}


@pytest.mark.parametrize("name", PROBLEMS)
def test_catalogue(name):
    state = PROBLEMS[name].make()
    assert name.endswith(f"_d{state.dim}")
    assert 0 < state.p < 0.05 or name == "never_d4" or name in NOT_RARE
    assert state.standard_error <= 0.01 * state.p
    assert (PROBLEMS[name].group == "highdim") == (state.dim >= 30 and PROBLEMS[name].group != "public")
    assert (PROBLEMS[name].draws > 0) == (state.standard_error > 0)
    assert PROBLEMS[name].reference
    assert PROBLEMS[name].second
    rotated = state.problem(rotation=7)
    u = 2 * np.random.default_rng(2).standard_normal((200, state.dim))
    f = rotated.evaluate(u)
    assert f.shape == (200,)
    assert np.isfinite(f).all()
    if not state.noise:
        np.testing.assert_allclose(f, state.problem().evaluate(u @ random_rotation(state.dim, 7)))
