"""Traffic: the state of vehicles on a road, vehicle models, geometry, overlap and crashes."""

from rare_envs.traffic.crash import Crash, describe_crash

__all__ = ["Crash", "describe_crash"]
