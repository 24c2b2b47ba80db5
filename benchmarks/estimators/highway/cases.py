"""Cases on the highway: an ego, the noise of the drivers around it, a measure and its threshold."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rare_envs
from agents import load_ego

HIGHWAY_ID = "rare_envs/Highway-v0"
COUNTED_EGO = str(Path(__file__).with_name("imitation_uncorrected.safetensors"))
"""The ego `imitation` before its corrections (`training.recipes.imitation`): the one whose failures were counted."""


@dataclass(frozen=True)
class HighwayWorld:
    """An ego among learned drivers; several cases may be read off the same rollouts."""

    ego: str
    noise: bool | str = True
    collisions: str = "ego"
    black_box: bool = False
    """Whether the ego shows its `predict` only, so that nothing can be differentiated through it."""

    def problem(self, measure: str) -> rare_envs.DrivingProblem:
        """Return the problem with a measure."""
        ego: Any = self.ego if self.ego == "idm" else load_ego(self.ego)
        return rare_envs.DrivingProblem(
            HIGHWAY_ID,
            ego=_BlackBox(ego) if self.black_box else ego,
            noise=self.noise,
            measure=measure,
            collisions=self.collisions,
        )


class _BlackBox:
    """A policy of which nothing but its answers is known."""

    def __init__(self, ego: Any) -> None:
        self.observation_space, self.action_space, self.predict = ego.observation_space, ego.action_space, ego.predict


@dataclass(frozen=True)
class HighwayCase:
    """P[f <= gamma]."""

    world: str
    """Key of `WORLDS`."""
    measure: str
    gamma: float


COUNTED_WORLDS = {
    "idm": HighwayWorld("idm"),
    "idm, noise fixed": HighwayWorld("idm", noise="fixed"),
    "imitation": HighwayWorld(COUNTED_EGO),
}
"""Worlds in which failures are counted."""
WORLDS = COUNTED_WORLDS | {
    "idm, any": HighwayWorld("idm", collisions="any"),
    "imitation, black box": HighwayWorld(COUNTED_EGO, black_box=True),
}
CASES = {
    "idm collisions": HighwayCase("idm", "clearance", 0.0),
    "imitation collisions": HighwayCase("imitation", "clearance", 0.0),
    "idm lidar_ttc 0.56": HighwayCase("idm, noise fixed", "lidar_ttc", 0.56),
    "idm lidar_ttc 0.46": HighwayCase("idm, noise fixed", "lidar_ttc", 0.46),
    "imitation lidar_ttc 0.52": HighwayCase("imitation", "lidar_ttc", 0.52),
    "idm any collisions": HighwayCase("idm, any", "clearance", 0.0),
    "black box collisions": HighwayCase("imitation, black box", "clearance", 0.0),
}
EARLIER_COUNTS = {
    "idm collisions": (44, 673_792),
    "imitation collisions": (41, 365_568),
    "idm lidar_ttc 0.56": (283, 412_000),
    "idm lidar_ttc 0.46": (3, 307_200),
    "imitation lidar_ttc 0.52": (290, 307_200),
}
"""Failures and rollouts of an earlier study, whose rollouts were those of this package transcribed to C++ (f equal to
1e-5): cited, not counted here. Its draws are others than ours."""
