"""Scenarios: what x means and how the vehicles around the ego move."""

from types import MappingProxyType

from rare_envs.scenarios.base import Scenario
from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.scenarios.cut_in import CUT_IN
from rare_envs.scenarios.highway import HIGHWAY

SCENARIOS: MappingProxyType[str, Scenario] = MappingProxyType(
    {"rare_envs/CarFollowing-v0": CAR_FOLLOWING, "rare_envs/CutIn-v0": CUT_IN, "rare_envs/Highway-v0": HIGHWAY}
)

__all__ = ["CAR_FOLLOWING", "CUT_IN", "HIGHWAY", "SCENARIOS", "Scenario"]
