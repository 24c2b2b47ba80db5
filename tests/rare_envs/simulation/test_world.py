"""The world refuses what makes no sense."""

import pytest

from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.episode import Clock, Measurement
from rare_envs.simulation.world import World


def test_worlds_refuse_nonsense() -> None:
    for kwargs in ({"dt": 0.0}, {"dt": float("nan")}, {"horizon": 0.01}, {"horizon": float("inf")}):
        with pytest.raises(ValueError, match="Expected"):
            World(CAR_FOLLOWING, clock=Clock(**kwargs))
    with pytest.raises(ValueError, match="ttc"):
        Measurement("tcc")
