"""What a measure looks at: one moment of B scenarios."""

from typing import NamedTuple

import torch
from torch import Tensor

from rare_envs.geometry import Lead
from rare_envs.road import Road
from rare_envs.state import State


class Moment(NamedTuple):
    """B scenarios at one moment."""

    state: State
    lead: Lead
    """The ego's."""
    road: Road
    perception: Tensor | None
    """What vehicles see, shape (B, M, 51), the ego first; None unless the measure needs it."""
    before: State | None = None
    """The state one tick earlier; None at the start."""
    dt: float = 0.1
    """Tick [s]."""

    @property
    def acceleration(self) -> Tensor:
        """Mean acceleration of every vehicle over the last tick [m/s^2], shape (B, N); 0 at the start."""
        if self.before is None:
            return torch.zeros_like(self.state.speed)
        return (self.state.speed - self.before.speed) / self.dt
