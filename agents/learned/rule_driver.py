"""A driver by rule that sees what learned drivers see."""

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.sensors.lidar import AHEAD_BEAM, MAX_RANGE
from rare_envs.sensors.perception import FEATURES, RANGE_COLUMNS, RATE_COLUMNS
from rare_envs.traffic.lead import Lead
from rare_envs.traffic.vehicle_models import NEAR_ZERO

_OFFSET, _HEADING, _SPEED, _LENGTH = (FEATURES.index(name) for name in ("lane_offset", "heading", "speed", "length"))
OFFSET_TIME = 0.6
"""[s]: an offset from the middle of the lane asks for offset / time of lateral speed."""
HEADING_TIME = 0.2
"""[s]: an error of heading asks for error / time of yaw rate."""


@dataclass(frozen=True)
class RuleDriver:
    """IDM behind what the beam ahead meets, and the lane keeping of `rare_envs.control.steering` as a yaw rate.

    It takes the place of a `LearnedDriver`, so that one harness measures both; it has no weights and no noise, and
    knows vehicles in its lane only where the beam meets them.
    """

    idm: IDM = field(default_factory=IDM)
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = False

    def begin(self, draws: Tensor) -> Tensor:
        """No memory: (B, M, 2, 2) -> (B, M, 0)."""
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
            weights: Passed over.
            innovations: Passed over.
            memory: Passed through.

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
