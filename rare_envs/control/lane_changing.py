"""IDM + MOBIL: rule-based drivers that follow, keep their lane, and change it where that is worth it.

MOBIL minimises the overall braking that a change induces. A change to a neighbouring lane is worth it if

    a~_c - a_c + p [(a~_n - a_n) + (a~_o - a_o)] > a_th,

with the accelerations of the changing vehicle c, its new follower n and its old follower o before and after (~) the
change, all by the car-following model; and safe if a~_n >= -b_safe.

References:
    Kesting, Treiber and Helbing, "General lane-changing model MOBIL for car-following models", Transportation Research
    Record 1999, 86-94, 2007: their symmetric rules, no lane is for overtaking only.
    Leurent, "An environment for autonomous driving decision-making", 2018: HighwayEnv, `IDMVehicle.mobil`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor

from rare_envs.control.idm import IDM, TAU_LATERAL, yaw_rate_towards
from rare_envs.traffic.bodies import LEFT, OWN, RIGHT, LaneTraffic, Lead, find_neighbours, nearest

_SIDES = (LEFT, RIGHT)
_NO_LIMIT = 1e12
"""A deceleration [m/s^2] that no gap asks for."""
SETTLED = 0.5
"""A change ends when the centre of the vehicle is this close to the middle of its target lane [m]."""


def acceleration_behind(traffic: LaneTraffic, idm: IDM, follower: Tensor, lead: Tensor) -> Tensor:
    """Return accelerations of followers behind leads [m/s^2], (B, M, K), by indices of V; 0 for none (-1)."""
    follower, lead = follower + torch.zeros_like(lead), lead + torch.zeros_like(follower)

    def of(values: Tensor, index: Tensor) -> Tensor:
        return values[:, None, :].expand(-1, index.shape[1], -1).gather(2, index.clamp(min=0))

    speed = of(traffic.speed, follower)
    centres = of(traffic.x, lead) - of(traffic.x, follower)
    gap = centres - 0.5 * (of(traffic.length, lead) + of(traffic.length, follower))
    along = of(traffic.speed, lead) * torch.cos(of(traffic.heading, lead) - of(traffic.heading, follower))
    free = lead < 0
    gap, closing_speed = torch.where(free, torch.inf, gap), torch.where(free, 0.0, speed - along)
    return torch.where(follower < 0, 0.0, idm.acceleration(speed, Lead(gap, closing_speed)))


@dataclass(frozen=True)
class LaneChangingDriver:
    """IDM along the road, MOBIL for the lane, and the lane keeping of `rare_envs.control.idm` towards it.

    Vehicles decide once in `delay`, each in a phase of its own that follows from its place at first, as in HighwayEnv.
    A change under way is not reconsidered until it ends or becomes unsafe while the centre is still in the old lane:
    then the vehicle goes back. Along the road it follows the nearest ahead in its lane, in its target lane, and in its
    way (bodies overlap across the road), whichever asks for more braking; while changing it counts in both lanes.

    HighwayEnv's `IDMVehicle` has politeness 0, a threshold of 0.2 m/s^2, at most 2 m/s^2 of braking imposed, a reach of
    1 m and no safety of its own, and takes the right one of two lanes that are worth it. Nothing is random, and nothing
    of it is part of x. Decisions jump, so f does too.
    """

    idm: IDM = field(default_factory=IDM)
    politeness: float = 0.25
    """p: weight of the others' accelerations; the middle of the range of 0 to 0.5 that Treiber calls realistic on his
    page about the model."""
    threshold: float = 0.1
    """a_th [m/s^2], as b_safe Kesting et al.'s (2007)."""
    safe_deceleration: float = 4.0
    """b_safe [m/s^2]."""
    delay: float = 1.0
    """Time between two decisions of a vehicle [s], HighwayEnv's; the paper decides at every step."""
    own_safety: bool = True
    """Whether the changing vehicle's own braking is limited by b_safe too: a vehicle that is abreast with its centre
    ahead is no follower, so that the paper's criterion does not see it."""
    reach: float = 0.0
    """Distance beyond a lane's edge [m] up to which a centre counts in the lane; in HighwayEnv 1 m."""
    least_speed: float = 1.0
    """Speed [m/s] below which nobody begins a change, HighwayEnv's."""
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
        if not (self.safe_deceleration > 0 and self.lateral_speed > 0 and self.threshold >= 0 and self.delay >= 0):
            raise ValueError(
                "Expected a positive safe deceleration and lateral speed and a threshold and a delay that are not "
                f"negative, got {self.safe_deceleration}, {self.lateral_speed}, {self.threshold} and {self.delay}."
            )

    def begin(self, draws: Tensor) -> Tensor:
        """Return the memory before the first decision: (B, M, 2, 2) -> (B, M, 2)."""
        return draws.new_zeros(*draws.shape[:2], 2)

    def decide(self, traffic: LaneTraffic, who: slice, memory: Tensor, dt: float) -> tuple[Tensor, Tensor]:
        """Return accelerations [m/s^2] and yaw rates [rad/s] of M of V vehicles for a tick, (B, M, 2), and new memory.

        The memory of each is its target lane + 1 and the time since it last decided [s], (B, M, 2).
        """
        lane, y = traffic.lane, traffic.y[:, who]
        new = memory[..., 0] == 0
        target = torch.where(new, lane[:, who], memory[..., 0].long() - 1)
        phase = torch.remainder((traffic.x[:, who] + y) * torch.pi, max(self.delay, 1e-6))
        timer = torch.where(new, phase, memory[..., 1]) + dt
        target, decided = self._choose_lanes(traffic, who, lane, target, timer >= self.delay)
        timer = torch.where(decided, 0.0, timer)
        offset = (y - traffic.centre(target)).clamp(-self.lateral_speed * TAU_LATERAL, self.lateral_speed * TAU_LATERAL)
        turn = yaw_rate_towards(offset, traffic.heading[:, who], traffic.speed[:, who]).clamp(*self.yaw_rate)
        action = torch.stack((self._accelerate(traffic, who, lane, target), turn), dim=-1)
        return action, torch.stack(((target + 1).to(timer.dtype), timer), dim=-1)

    def judge_changes(self, traffic: LaneTraffic, who: slice, target: Tensor) -> tuple[Tensor, Tensor]:
        """Return MOBIL's incentive [m/s^2], -inf without a lane, and safety of changes left and right, (B, M, 2).

        All V vehicles move to lanes `target` (B, V). Accelerations are not limited to what the brakes can do, here and
        in the paper.
        """
        ahead, behind, exists = find_neighbours(traffic, who, target, self.reach)
        unlimited = replace(self.idm, max_deceleration=_NO_LIMIT)
        batch, m, _ = ahead.shape
        own = torch.arange(traffic.x.shape[1], device=traffic.x.device)[who].view(1, m, 1).expand(batch, m, 2)
        lead, follower = ahead[..., _SIDES], behind[..., _SIDES]
        old_lead, old_follower = ahead[..., OWN, None], behind[..., OWN, None]

        def by(follower: Tensor, lead: Tensor) -> Tensor:
            return acceleration_behind(traffic, unlimited, follower, lead)

        after = by(own, lead)
        of_follower = by(follower, own)
        gain = after - by(own[..., :1], old_lead)
        others = of_follower - by(follower, lead) + by(old_follower, old_lead) - by(old_follower, own[..., :1])
        exists = exists[..., _SIDES]
        incentive = torch.where(exists, gain + self.politeness * others, -torch.inf)
        safe = exists & (of_follower >= -self.safe_deceleration)
        if self.own_safety:
            safe = safe & (after >= -self.safe_deceleration)
        return incentive, safe

    def _choose_lanes(
        self, traffic: LaneTraffic, who: slice, lane: Tensor, target: Tensor, may_decide: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the new target lanes (B, M), and who has decided or gone back."""
        own = lane[:, who]
        incentive, safe = self.judge_changes(traffic, who, _all_targets(lane, who, target))
        side = target - own
        towards = safe.gather(2, (side > 0).long()[..., None])[..., 0]
        gone_back = (side != 0) & ~(towards & (side.abs() == 1))  # a change by more lanes than one is not safe
        settled = (side == 0) & ((traffic.y[:, who] - traffic.centre(target)).abs() <= SETTLED)
        decides = may_decide & settled
        best = torch.where(safe & (incentive >= self.threshold), incentive, -torch.inf).max(dim=-1)
        moves = decides & (best.values > -torch.inf) & (traffic.speed[:, who] >= self.least_speed)
        target = torch.where(gone_back, own, torch.where(moves, own + 2 * best.indices - 1, target))
        return target, gone_back | decides

    def _accelerate(self, traffic: LaneTraffic, who: slice, lane: Tensor, target: Tensor) -> Tensor:
        """Return accelerations (B, M) behind the nearest ahead in the lane, in the target lane and in the way."""
        targets = _all_targets(lane, who, target)
        own, _, _ = find_neighbours(traffic, who, targets)
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
