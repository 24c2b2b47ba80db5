"""IDM + MOBIL: rule-based drivers of the traffic that follow, keep their lane, and change it where that is worth it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.control.mobil import LaneChoice, Mobil, acceleration_behind
from rare_envs.control.steering import TAU_LATERAL, yaw_rate_towards
from rare_envs.traffic.neighbours import OWN, LaneTraffic, find_neighbours, nearest

SETTLED = 0.5
"""A change ends when the centre of the vehicle is this close to the middle of its target lane [m]."""


@dataclass(frozen=True)
class LaneChangingDriver:
    """IDM along the road, MOBIL for the lane, and the lane keeping of `rare_envs.control.steering` towards it.

    Vehicles decide once in `Mobil.delay`, each in a phase of its own that follows from its place when it is first
    driven, as in HighwayEnv. A change under way is not reconsidered until it ends (the centre is within `SETTLED` of
    the middle of the target lane) or becomes unsafe by MOBIL's criterion of safety while the centre is still in the old
    lane: then the vehicle goes back. HighwayEnv's changes end when the centre crosses the line, and are taken back
    when somebody else ahead and too near moves to the same lane.

    Along the road a vehicle follows the nearest ahead in its lane, in its target lane, and in its way (bodies overlap
    across the road), whichever asks for more braking. A vehicle that is changing counts in both lanes, so others make
    room as for one that signals.

    Nothing is random, and nothing of it is part of x: there are no weights and no noise. Decisions jump, so f does too.

    Raises:
        ValueError: If the lateral speed is not positive.

    Example:
        >>> from rare_envs.traffic import State, straight
        >>> x, y = torch.tensor([[0.0, 20.0]]), torch.tensor([[4.0, 4.0]])  # a slow lead, the left lane is free
        >>> state = State(x, y, 0 * x, torch.tensor([[20.0, 10.0]]), theta=x[:, :0])
        >>> driver = LaneChangingDriver(mobil=Mobil(delay=0.0))
        >>> memory = driver.begin(torch.zeros(1, 1, 2, 2))
        >>> action, memory = driver.decide(LaneTraffic.of(state, straight(2)), slice(0, 1), memory, 0.1)
        >>> action[0, 0, 1].item() < 0  # it turns to the left
        True
    """

    idm: IDM = field(default_factory=IDM)
    mobil: Mobil = field(default_factory=Mobil)
    lateral_speed: float = 1.0
    """Largest speed across the road that is aimed at [m/s]: the median of the largest ones in 372 recorded changes on
    US 101 (NGSIM). HighwayEnv has no limit, so that its changes take a second."""
    yaw_rate: tuple[float, float] = (-0.3, 0.3)
    """Limits [rad/s]."""
    weights: ClassVar[None] = None
    noisy: ClassVar[bool] = False
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    def __post_init__(self) -> None:
        if not self.lateral_speed > 0:
            raise ValueError(f"Expected a positive lateral speed in m/s, got {self.lateral_speed!r}.")

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory before the first decision: (B, M, 2, 2) -> (B, M, 2)."""
        return draws.new_zeros(*draws.shape[:2], 2)

    def decide(self, traffic: LaneTraffic, who: slice, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Decide for one tick.

        Args:
            traffic: B scenes of V vehicles.
            who: The M vehicles that are driven, of the V.
            memory: Of each, its target lane + 1 and the time since it last decided [s], shape (B, M, 2).
            dt: Tick [s].

        Returns:
            Accelerations [m/s^2] and yaw rates relative to the road [rad/s], shape (B, M, 2), and the new memory.
        """
        lane, y = traffic.lane, traffic.y[:, who]
        new = memory[..., 0] == 0
        target = torch.where(new, lane[:, who], memory[..., 0].long() - 1)
        phase = torch.remainder((traffic.x[:, who] + y) * torch.pi, max(self.mobil.delay, 1e-6))
        timer = torch.where(new, phase, memory[..., 1]) + dt
        target, decided = self._choose_lanes(traffic, who, lane, target, timer >= self.mobil.delay)
        timer = torch.where(decided, 0.0, timer)
        offset = (y - traffic.centre(target)).clamp(-self.lateral_speed * TAU_LATERAL, self.lateral_speed * TAU_LATERAL)
        turn = yaw_rate_towards(offset, traffic.heading[:, who], traffic.speed[:, who]).clamp(*self.yaw_rate)
        action = torch.stack((self._accelerate(traffic, who, lane, target), turn), dim=-1)
        return action, torch.stack(((target + 1).to(timer.dtype), timer), dim=-1)

    def _choose_lanes(
        self, traffic: LaneTraffic, who: slice, lane: Tensor, target: Tensor, may_decide: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the new target lanes (B, M), and who has decided or gone back."""
        own = lane[:, who]
        choice = self.mobil.choose(traffic, who, self.idm, _all_targets(lane, who, target))
        side = target - own
        gone_back = (side != 0) & ~_is_safe(choice, side)
        settled = (side == 0) & ((traffic.y[:, who] - traffic.centre(target)).abs() <= SETTLED)
        decides = may_decide & settled
        best = torch.where(choice.wanted, choice.incentive, -torch.inf).max(dim=-1)
        moves = decides & (best.values > -torch.inf) & (traffic.speed[:, who] >= self.mobil.least_speed)
        target = torch.where(gone_back, own, torch.where(moves, own + 2 * best.indices - 1, target))
        return target, gone_back | decides

    def _accelerate(self, traffic: LaneTraffic, who: slice, lane: Tensor, target: Tensor) -> Tensor:
        """Return accelerations (B, M) behind the nearest ahead in the lane, in the target lane and in the way."""
        targets = _all_targets(lane, who, target)
        own = find_neighbours(traffic, who, targets).lead
        side = (target - lane[:, who]).clamp(-1, 1)
        in_target = own.gather(2, (side + OWN)[..., None])
        ahead = traffic.x[:, None, :] - traffic.x[:, who, None]
        aside = (traffic.y[:, None, :] - traffic.y[:, who, None]).abs()
        itself = torch.eye(lane.shape[1], dtype=torch.bool, device=lane.device)[who]
        in_way = aside < 0.5 * (traffic.width[:, None, :] + traffic.width[:, who, None])
        blocking = nearest(ahead, in_way & (ahead >= 0) & ~itself)
        leads = torch.cat((own[..., OWN, None], in_target, blocking[..., None]), dim=-1)
        every = torch.arange(lane.shape[1], device=lane.device)[who].view(1, -1, 1).expand_as(leads)
        return acceleration_behind(traffic, self.idm, every, leads).amin(dim=-1)


def _all_targets(lane: Tensor, who: slice, target: Tensor) -> Tensor:
    """Return the target lanes of all V vehicles (B, V): theirs for the M driven ones, the own lane for the others."""
    targets = lane.clone()
    targets[:, who] = target
    return targets


def _is_safe(choice: LaneChoice, side: Tensor) -> Tensor:
    """Return whether a change by -1 or 1 lanes is safe, (B, M); one by more lanes is not."""
    towards = choice.safe.gather(2, (side > 0).long()[..., None])[..., 0]
    return towards & (side.abs() == 1)
