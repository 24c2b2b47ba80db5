"""Traffic: the state of vehicles on a road, vehicle models, geometry, overlap and crashes."""

from rare_envs.traffic.bodies import Lead, boxes_overlap, lead_of
from rare_envs.traffic.crash import CRASH_KINDS, Crash, describe_crash, injury_risk
from rare_envs.traffic.road import ReferenceLine, Road, WorldPose, i80, straight
from rare_envs.traffic.state import LANE_WIDTH, VEHICLE_LENGTH, VEHICLE_WIDTH, State, bicycle, point_mass

__all__ = [
    "CRASH_KINDS",
    "LANE_WIDTH",
    "VEHICLE_LENGTH",
    "VEHICLE_WIDTH",
    "Crash",
    "Lead",
    "ReferenceLine",
    "Road",
    "State",
    "WorldPose",
    "bicycle",
    "boxes_overlap",
    "describe_crash",
    "i80",
    "injury_risk",
    "lead_of",
    "point_mass",
    "straight",
]
