"""The distribution of gaps on HighwayEnv's highway."""

import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from scipy import stats

from tests.rare_envs.interop.scenes import scenario


def test_density_of_the_spacing_is_the_jacobian_of_its_map() -> None:
    spacing = scenario("highway-fast-v0", vehicles=2).space.base.blocks[2]
    x = spacing.sample(5, np.random.default_rng(1))
    u = spacing.to_standard_normal(x)
    steps = 1e-6 * np.eye(spacing.dim)
    for row, point in enumerate(u):
        jacobian = np.stack(
            [
                (spacing.from_standard_normal((point + h)[None]) - spacing.from_standard_normal((point - h)[None]))[0]
                / 2e-6
                for h in steps
            ]
        )
        expected = stats.norm.logpdf(point).sum() - np.log(abs(np.linalg.det(jacobian)))
        assert spacing.log_prob(x[row : row + 1])[0] == pytest.approx(expected, abs=1e-5)
