"""Minimum, weighted sum and a value of their own for collisions."""

import numpy as np

from rare_envs.measures import (
    minimum,
    weighted,
    with_collision,
)
from tests.rare_envs.measures.moments import AWAY, CLOSE, HIT, problem


def test_combinations() -> None:
    x = np.array([HIT, CLOSE, AWAY, (15.0, 14.0, 13.0)])
    of = {name: problem(name).evaluate(x) for name in ("ttc", "drac", "thw", "tet", "pet")}
    both = problem(minimum("ttc", "drac", "pet")).evaluate(x)
    np.testing.assert_array_equal(both, np.min([of["ttc"], of["drac"], of["pet"]], axis=0))
    added = problem(weighted(("ttc", 0.5), ("thw", 2.0), ("tet", 1.0))).evaluate(x)
    np.testing.assert_allclose(added, 0.5 * of["ttc"] + 2.0 * of["thw"] + of["tet"], rtol=1e-6)
    on_top = problem(with_collision(weighted(("thw", 2.0)))).evaluate(x)
    np.testing.assert_allclose(on_top, [-1.0, *(2.0 * of["thw"][1:])], rtol=1e-6)
    nested = problem(minimum(weighted(("ttc", 1.0)), with_collision("drac", -7.0))).evaluate(x)
    assert nested[0] == -7.0
