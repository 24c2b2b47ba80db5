"""Scenarios: what x means and how the vehicles around the ego move, and all that a file with one of your own needs."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr
from rare_envs.scenarios.registry import SCENARIOS, find_scenario

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
    "straight",
]

_LAZY = {
    "rare_envs.distributions.space": "Parameter",
    "rare_envs.scenarios.base": "Others Scenario columns drive_points keep_straight load_base",
    "rare_envs.traffic.road": "ReferenceLine Road i80 straight",
    "rare_envs.traffic.state": "LANE_WIDTH VEHICLE_LENGTH VEHICLE_WIDTH State",
}
"""Names that need torch, which `import rare_envs` must not import, by their modules."""

__getattr__ = make_lazy_getattr(__name__, {name: module for module, names in _LAZY.items() for name in names.split()})
