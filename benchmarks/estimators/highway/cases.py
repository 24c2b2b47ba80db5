"""Cases on the highway: an ego, the noise of the drivers around it, a measure and its threshold."""

from dataclasses import dataclass
from typing import Any

import rare_envs
from agents import load_ego

HIGHWAY_ID = "rare_envs/Highway-v0"


@dataclass(frozen=True)
class HighwayWorld:
    """An ego among learned drivers; several cases may be read off the same rollouts."""

    ego: str
    noise: bool | str

    def problem(self, measure: str) -> rare_envs.DrivingProblem:
        """Return the problem with a measure."""
        ego: Any = self.ego if self.ego == "idm" else load_ego(self.ego)
        return rare_envs.DrivingProblem(HIGHWAY_ID, ego=ego, noise=self.noise, measure=measure)


@dataclass(frozen=True)
class HighwayCase:
    """P[f <= gamma]."""

    world: str
    """Key of `WORLDS`."""
    measure: str
    gamma: float


WORLDS = {
    "idm": HighwayWorld("idm", noise=True),
    "idm, noise fixed": HighwayWorld("idm", noise="fixed"),
    "imitation": HighwayWorld("imitation", noise=True),
}
CASES = {
    "idm collisions": HighwayCase("idm", "clearance", 0.0),
    "imitation collisions": HighwayCase("imitation", "clearance", 0.0),
    "idm lidar_ttc 0.56": HighwayCase("idm, noise fixed", "lidar_ttc", 0.56),
    "idm lidar_ttc 0.46": HighwayCase("idm, noise fixed", "lidar_ttc", 0.46),
    "imitation lidar_ttc 0.52": HighwayCase("imitation", "lidar_ttc", 0.52),
}
