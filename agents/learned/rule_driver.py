"""The rule-based driver of learned drivers' observations: IDM and lane keeping on 51 features."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.sensors.lidar import AHEAD_BEAM, FEATURES, MAX_RANGE, RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.traffic.neighbours import Lead
from rare_envs.traffic.vehicle_models import NEAR_ZERO

_OFFSET, _HEADING, _SPEED, _LENGTH = (FEATURES.index(name) for name in ("lane_offset", "heading", "speed", "length"))
OFFSET_TIME = 0.6
"""The lateral speed that is aimed at is lane offset / this [s], as in `rare_envs.control.idm`."""
HEADING_TIME = 0.2
"""The yaw rate is heading error / this [s], as in `rare_envs.control.idm`."""


@dataclass(frozen=True)
class RuleDriver:
    """IDM behind what the beam ahead meets, and the lane keeping of `rare_envs.control.idm` as a yaw rate.

    It has the interface of a `LearnedDriver`, so that one harness measures both; it has no weights and no noise, and
    knows vehicles in its lane only where the beam meets them.

    Example:
        >>> features = torch.zeros(1, 1, 51)
        >>> action, _ = RuleDriver().act(features)
        >>> tuple(action.shape)
        (1, 1, 2)
    """

    idm: IDM = field(default_factory=IDM)
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = False
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    def begin(self, draws: Tensor) -> Tensor:
        """Return an empty memory: (B, M, 2, 2) -> (B, M, 0)."""
        return draws[..., 0, :0]

    def act(
        self,
        features: Tensor,
        weights: Tensor | None = None,
        innovations: Tensor | None = None,
        memory: Tensor | None = None,
    ) -> tuple[Tensor, Tensor | None]:
        """Decide for one tick.

        Args:
            features: Shape (B, M, 51).
            weights: Not used.
            innovations: Not used.
            memory: Returned as it is.

        Returns:
            Accelerations [m/s^2] and yaw rates [rad/s], shape (B, M, 2), and the memory.
        """
        ahead, rate = features[..., RANGE_COLUMNS][..., AHEAD_BEAM], features[..., RATE_COLUMNS][..., AHEAD_BEAM]
        speed = features[..., _SPEED]
        gap = torch.where(ahead < MAX_RANGE, ahead - 0.5 * features[..., _LENGTH], torch.inf)
        acceleration = self.idm.acceleration(speed, Lead(gap, -rate))
        across = -features[..., _OFFSET] / (OFFSET_TIME * speed.clamp(min=NEAR_ZERO))
        wanted = torch.asin(across.clamp(-1.0, 1.0)).clamp(-torch.pi / 4, torch.pi / 4)
        yaw_rate = ((wanted - features[..., _HEADING]) / HEADING_TIME).clamp(*self.yaw_rate)
        return torch.stack((acceleration, yaw_rate), dim=-1), memory
