"""Scenarios: what x means and how the vehicles around the ego move, and all that a file with one of your own needs."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr
from rare_envs.scenarios.registry import SCENARIOS, find_scenario, scenario_named

if TYPE_CHECKING:
    from rare_envs.distributions.space import Parameter
    from rare_envs.scenarios.base import Others, Scenario, columns, drive_points, keep_straight, load_base
    from rare_envs.traffic.road import ReferenceLine, Road, i80, straight
    from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, VEHICLE_WIDTH, State

__all__ = [
    "LANE_WIDTH",
    "SCENARIOS",
    "VEHICLE_LENGTH",
    "VEHICLE_WIDTH",
    "Others",
    "Parameter",
    "ReferenceLine",
    "Road",
    "Scenario",
    "State",
    "columns",
    "drive_points",
    "find_scenario",
    "i80",
    "keep_straight",
    "load_base",
    "scenario_named",
    "straight",
]

_LAZY = {
    "LANE_WIDTH": "rare_envs.traffic.state",
    "VEHICLE_LENGTH": "rare_envs.traffic.state",
    "VEHICLE_WIDTH": "rare_envs.traffic.state",
    "Others": "rare_envs.scenarios.base",
    "Parameter": "rare_envs.distributions.space",
    "ReferenceLine": "rare_envs.traffic.road",
    "Road": "rare_envs.traffic.road",
    "Scenario": "rare_envs.scenarios.base",
    "State": "rare_envs.traffic.state",
    "columns": "rare_envs.scenarios.base",
    "drive_points": "rare_envs.scenarios.base",
    "i80": "rare_envs.traffic.road",
    "keep_straight": "rare_envs.scenarios.base",
    "load_base": "rare_envs.scenarios.base",
    "straight": "rare_envs.traffic.road",
}
"""Names that need torch, which `import rare_envs` must not import."""

__getattr__ = make_lazy_getattr(__name__, _LAZY)
