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
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.idm import IDM, TAU_LATERAL, yaw_rate_towards
from rare_envs.traffic.bodies import LEFT, OWN, RIGHT, LaneTraffic, Lead, Neighbours, find_neighbours, nearest

_SIDES = (LEFT, RIGHT)
_NO_LIMIT = 1e12
"""A deceleration [m/s^2] that no gap asks for."""


class LaneChoice(NamedTuple):
    """Value of changes of M vehicles to the lane on the left and on the right; shapes (B, M, 2)."""

    incentive: Tensor
    """Left-hand side of the criterion [m/s^2]; -inf where there is no lane."""
    safe: Tensor
    """Whether there is a lane, and nobody would have to brake harder than is safe."""
    wanted: Tensor
    """Whether the change is safe and worth it."""


@dataclass(frozen=True)
class Mobil:
    """Parameters of MOBIL.

    Threshold and safe deceleration are those of Kesting et al. (2007). Where HighwayEnv's `IDMVehicle` differs
    (`Mobil.highway_env`): politeness 0, a threshold of 0.2 m/s^2, at most 2 m/s^2 of braking imposed. It does not look
    at what the changing vehicle itself would have to brake. Vehicles count in a lane up to 1 m beyond its edge, so that
    one counts in two lanes. Of two lanes that are worth it HighwayEnv takes the right one, we the better one.
    Accelerations are not limited to what the brakes can do, in both and in the paper.
    """

    politeness: float = 0.25
    """p: weight of the others' accelerations; the middle of the range of 0 to 0.5 that Treiber calls realistic on his
    page about the model."""
    threshold: float = 0.1
    """a_th [m/s^2]."""
    safe_deceleration: float = 4.0
    """b_safe [m/s^2]."""
    delay: float = 1.0
    """Time between two decisions of a vehicle [s], HighwayEnv's; the paper decides at every step."""
    own_safety: bool = True
    """Whether the changing vehicle's own braking is limited by b_safe too: a vehicle that is abreast with its centre
    ahead is no follower, so that the paper's criterion does not see it."""
    reach: float = 0.0
    """Distance beyond a lane's edge [m] up to which a centre counts in the lane."""
    least_speed: float = 1.0
    """Speed [m/s] below which nobody begins a change, HighwayEnv's."""

    def __post_init__(self) -> None:
        if not self.safe_deceleration > 0 or self.threshold < 0 or self.delay < 0:
            raise ValueError(
                "Expected a positive safe deceleration and a threshold and a delay that are not negative, got "
                f"{self.safe_deceleration}, {self.threshold} and {self.delay}."
            )

    @classmethod
    def highway_env(cls) -> Mobil:
        """Return the parameters and conventions of HighwayEnv's `IDMVehicle`."""
        return cls(0.0, 0.2, 2.0, 1.0, own_safety=False, reach=1.0)

    def choose(self, traffic: LaneTraffic, who: slice, idm: IDM, target: Tensor | None = None) -> LaneChoice:
        """Return what changes to both sides are worth to M of V vehicles, which move to lanes `target` (B, V)."""
        around = find_neighbours(traffic, who, traffic.lane if target is None else target, self.reach)
        return self.judge(traffic, who, idm, around)

    def judge(self, traffic: LaneTraffic, who: slice, idm: IDM, around: Neighbours) -> LaneChoice:
        """Return the same for known neighbours."""
        unlimited = replace(idm, max_deceleration=_NO_LIMIT)
        batch, m, _ = around.lead.shape
        own = torch.arange(traffic.x.shape[1], device=traffic.x.device)[who].view(1, m, 1).expand(batch, m, 2)
        lead, follower = around.lead[..., _SIDES], around.follower[..., _SIDES]
        old_lead, old_follower = around.lead[..., OWN, None], around.follower[..., OWN, None]

        def by(behind: Tensor, ahead: Tensor) -> Tensor:
            return acceleration_behind(traffic, unlimited, behind, ahead)

        after = by(own, lead)
        of_follower = by(follower, own)
        gain = after - by(own[..., :1], old_lead)
        others = of_follower - by(follower, lead) + by(old_follower, old_lead) - by(old_follower, own[..., :1])
        exists = around.exists[..., _SIDES]
        incentive = torch.where(exists, gain + self.politeness * others, -torch.inf)
        safe = exists & (of_follower >= -self.safe_deceleration)
        if self.own_safety:
            safe = safe & (after >= -self.safe_deceleration)
        return LaneChoice(incentive, safe, safe & (incentive >= self.threshold))


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


SETTLED = 0.5
"""A change ends when the centre of the vehicle is this close to the middle of its target lane [m]."""


@dataclass(frozen=True)
class LaneChangingDriver:
    """IDM along the road, MOBIL for the lane, and the lane keeping of `rare_envs.control.idm` towards it.

    Vehicles decide once in `Mobil.delay`, each in a phase of its own that follows from its place when it is first
    driven, as in HighwayEnv. A change under way is not reconsidered until it ends (the centre is within `SETTLED` of
    the middle of the target lane) or becomes unsafe by MOBIL's criterion of safety while the centre is still in the old
    lane: then the vehicle goes back. HighwayEnv's changes end when the centre crosses the line, and are taken back
    when somebody else ahead and too near moves to the same lane.

    Along the road a vehicle follows the nearest ahead in its lane, in its target lane, and in its way (bodies overlap
    across the road), whichever asks for more braking. A vehicle that is changing counts in both lanes, so others make
    room as for one that signals.

    Nothing is random, and nothing of it is part of x: there are no weights and no noise. Decisions jump, so f does too.
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
        """Return accelerations [m/s^2] and yaw rates [rad/s] of M of V vehicles for a tick, (B, M, 2), and new memory.

        The memory of each is its target lane + 1 and the time since it last decided [s], (B, M, 2).
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
