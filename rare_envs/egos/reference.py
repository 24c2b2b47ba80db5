"""Reference drivers as egos: the competent and careful human and the ALKS of UN Regulation 157, FSM and RSS.

Each says which vehicles it notices and how hard it wants to brake for them. It brakes a reaction time after a danger
began, with limited jerk, for as long as there is one; later in the episode it is alert and brakes at once. These are
equations of emergencies. Between them a driver keeps its initial speed and follows by the improved IDM
(`rare_envs.control.idm`), a reaction time late and by at most 4 m/s^2; `cruise=False` is without, as the published
comparisons are. It keeps its lane. All is deterministic. `benchmarks.driving.reference_grid` has the Regulation's
cut-ins beside the verdicts of the JRC's code.

References:
    UN Regulation 157 (ALKS), 2021, paragraph 5.2.5 and annex 4, appendix 3. The text was not consulted: values are
    those of the public implementations, github.com/ec-jrc/JRC-FSM (2021) and esmini's `ALKS_R157SM` controller.
    Mattas et al., "Fuzzy surrogate safety metrics for real-time assessment of rear-end collision risk", Accident
    Analysis and Prevention 148, 2020; "Driver models for the definition of safety requirements of automated vehicles in
    international regulations", Accident Analysis and Prevention 174, 2022: the four beside each other.
    Shalev-Shwartz, Shammah and Shashua, "On a formal model of safe and scalable self-driving cars", 2017, RSS.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any, ClassVar, Final, NamedTuple

import torch
from torch import Tensor

from rare_envs.control.human_driver import ATTENTIVE_IDM, MAX_HUMAN_BRAKING, find_ahead
from rare_envs.control.idm import IDM, check_numbers, improved_acceleration, lane_keeping
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.world import World
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.state import NEAR_ZERO, VEHICLE_LENGTH, VEHICLE_WIDTH

CRUISE_BRAKING = 4.0
"""Hardest braking between emergencies [m/s^2], esmini's."""
HARD_BRAKING = 5.0
"""A lead that brakes at least as hard [m/s^2] is a risk: Regulation 157, its deceleration scenario."""
CRITICAL_HEADWAY = 2.0
"""... at this headway or less [s]: the following distance in that scenario."""
SLOWEST = 1.0
"""Least speed that is kept [m/s], by who began standing."""


class Scene(NamedTuple):
    """What B drivers see of V other vehicles, (B, V) each unless said otherwise.

    Places are those after the tick: its motion is that of the present speeds, whatever is decided, and what is decided
    shows in the speeds after it. So the JRC's code has it.
    """

    gap: Tensor
    """Bumper to bumper along the road [m], negative side by side."""
    beside: Tensor
    """Between the sides of the bodies [m], negative where they overlap across."""
    offset: Tensor
    """Of the other's centre from the middle of the driver's lane [m], at least 0."""
    inward: Tensor
    """Speed of the other across, towards the driver [m/s]."""
    speed: Tensor
    """Of the other [m/s]."""
    braking: Tensor
    """Of the other [m/s^2]."""
    own_speed: Tensor
    """[m/s], (B, 1)."""
    own_acceleration: Tensor
    """[m/s^2], (B, 1)."""
    lane_width: float
    """[m]."""
    dt: float
    """Tick [s]."""

    @property
    def closing(self) -> Tensor:
        """Own speed less the other's [m/s]."""
        return self.own_speed - self.speed

    @property
    def ttc(self) -> Tensor:
        """Time to collision along the road [s], infinite without closing."""
        closing = self.closing
        return torch.where(closing > 0.0, self.gap.clamp_min(0.0) / closing.clamp_min(NEAR_ZERO), torch.inf)

    @property
    def in_lane(self) -> Tensor:
        """Whether the other's centre is in the driver's lane, boolean."""
        return self.offset <= self.lane_width / 2

    @property
    def stops_hard(self) -> Tensor:
        """Whether the other is a lead that brakes hard, closely followed, boolean."""
        near = self.gap <= CRITICAL_HEADWAY * self.own_speed
        return self.in_lane & near & (self.braking >= HARD_BRAKING)


_RANGES: Final = {
    "of at least 0, finite": ("reaction_time", "evaluation_time", "max_braking", "release", "time_headway"),
    "above 0": ("jerk",),
}


@dataclass(frozen=True, kw_only=True)
class ReferenceModel(ABC):
    """What the reference drivers share.

    Raises:
        ValueError: A parameter is negative or, the jerk apart, infinite.
    """

    reaction_time: float = 0.75
    """From a danger to braking [s]."""
    evaluation_time: float = 0.0
    """For which a vehicle has to be noticed before it can be a danger [s]."""
    jerk: float = 12.65
    """Fastest build-up of braking [m/s^3]: 0.774 g within 0.6 s."""
    max_braking: float = MAX_HUMAN_BRAKING
    """[m/s^2], 0.774 g."""
    release: float = 0.0
    """Deceleration within the reaction time [m/s^2]."""
    time_headway: float = 2.0
    """T of the improved IDM between dangers [s]."""
    cruise: bool = True
    """Whether it follows by the improved IDM between dangers; without, it keeps its speed."""

    def __post_init__(self) -> None:
        check_numbers(self, "reference driver", _RANGES)

    @abstractmethod
    def notices(self, scene: Scene) -> Tensor:
        """Return which vehicles are noticed, boolean, (B, V)."""

    @abstractmethod
    def wanted(self, scene: Scene) -> Tensor:
        """Return the deceleration that each vehicle asks for once noticed [m/s^2], 0 without danger, (B, V)."""


@dataclass(frozen=True, kw_only=True)
class CarefulHuman(ReferenceModel):
    """`cc_human`, the competent and careful human driver of Regulation 157.

    A vehicle of the next lane is a risk when its centre is off that lane's centre by more than 0.375 m and moves on
    towards the driver; a lead is one at TTC <= 2 s, or if it brakes by 5 m/s^2 or more at a headway of 2 s or less. It
    is evaluated for 0.4 s. If TTC <= 2 s then, or the lead still brakes so, 0.75 s pass at 0.4 m/s^2; after these the
    braking builds up to 0.774 g. The JRC's code has no evaluation, and starts at a cut-in when the bodies overlap.

    Example:
        >>> round(CarefulHuman().max_braking, 2)
        7.59
    """

    evaluation_time: float = 0.4
    release: float = 0.4
    critical_ttc: float = 2.0
    """[s]."""
    wandering: float = 0.375
    """[m]."""

    def notices(self, scene: Scene) -> Tensor:
        """See the base class."""
        enters = (scene.offset < scene.lane_width - self.wandering) & (scene.inward > 0.0)
        return enters | (scene.in_lane & (self.wanted(scene) > 0.0))

    def wanted(self, scene: Scene) -> Tensor:
        """See the base class."""
        return self.max_braking * ((scene.ttc <= self.critical_ttc) | scene.stops_hard).to(scene.gap.dtype)


@dataclass(frozen=True, kw_only=True)
class LaneKeepingSystem(ReferenceModel):
    """`alks`, the automated lane keeping system of Regulation 157, paragraph 5.2.5.

    A vehicle is noticed when its side is 0.3 m inside the lane, and a danger at TTC <= closing speed / (2 * 6 m/s^2) +
    0.35 s and a tick. 0.35 s later it brakes by 6 m/s^2, at once. It follows at 1.6 s, its least at 60 km/h.
    """

    reaction_time: float = 0.35
    jerk: float = math.inf
    max_braking: float = 6.0
    time_headway: float = 1.6
    intrusion: float = 0.3
    """[m]."""

    def notices(self, scene: Scene) -> Tensor:
        """See the base class."""
        return scene.offset - VEHICLE_WIDTH / 2 < scene.lane_width / 2 - self.intrusion

    def wanted(self, scene: Scene) -> Tensor:
        """See the base class."""
        critical = scene.closing / (2.0 * self.max_braking) + self.reaction_time + scene.dt
        return self.max_braking * ((scene.ttc <= critical) | scene.stops_hard).to(scene.gap.dtype)


@dataclass(frozen=True, kw_only=True)
class ResponsibilitySensitive(ReferenceModel):
    """`rss`, the proper response of RSS, with the parameters of the JRC's comparison.

    With response time r = 0.75 s, a = 3 and b = 6 m/s^2, w = 1 m/s^2 across and mu = 0.3 m, a vehicle ahead with speed
    v_l is a danger where it is nearer than both of

        along:  v r + a r^2 / 2 + (v + r a)^2 / (2 b) - v_l^2 / (2 b)
        across: mu + (2 u + w r) r / 2 + (u + w r)^2 / (2 w),    u its speed towards the driver, at least 0.
    """

    max_acceleration: float = 3.0
    """a [m/s^2]."""
    braking: float = 6.0
    """b [m/s^2], of both."""
    lateral_acceleration: float = 1.0
    """w [m/s^2]."""
    fluctuation: float = 0.3
    """mu [m]."""

    def notices(self, scene: Scene) -> Tensor:
        """See the base class."""
        u, w, r = scene.inward.clamp_min(0.0), self.lateral_acceleration, self.reaction_time
        return scene.beside < self.fluctuation + (2.0 * u + w * r) * r / 2.0 + (u + w * r).square() / (2.0 * w)

    def wanted(self, scene: Scene) -> Tensor:
        """See the base class."""
        v, r, a, twice = scene.own_speed, self.reaction_time, self.max_acceleration, 2.0 * self.braking
        safe = v * r + a * r**2 / 2.0 + (v + r * a).square() / twice - scene.speed.square() / twice
        return self.max_braking * (scene.gap < safe).to(scene.gap.dtype)


@dataclass(frozen=True, kw_only=True)
class FuzzySafety(ReferenceModel):
    """`fsm`, the JRC's fuzzy safety model, which brakes early and softly where that is enough.

    With reaction time r, comfortable and hard braking b = 4 and B = 6 m/s^2 and a lead's hardest braking 7 m/s^2, a gap
    s has two memberships, 0 at what is safe, 1 at what is not, linear in between:

        PFS of s - 2 m:  safe v r + v^2 / (2 b) - v_l^2 / 14 + 2 m, unsafe v r + v^2 / (2 B) - v_l^2 / 14
        CFS of s:  safe d + n^2 / (2 b), unsafe d + n^2 / (2 B), d = (v + a r / 2 - v_l) r, n = v + a r - v_l, by the
                   own acceleration a >= -b; 1 if n < 0 and s < (v - v_l)^2 / |2 a|

    It brakes by b + CFS (B - b) where CFS > 0, else by PFS b. Before bodies overlap across, a vehicle is noticed if it
    would come in, at its speed across, before the driver has passed it.
    """

    comfortable_braking: float = 4.0
    """b [m/s^2]."""
    hard_braking: float = 6.0
    """B [m/s^2]."""
    lead_braking: float = 7.0
    """[m/s^2]."""
    margin: float = 2.0
    """[m], once for the gap and once for the safe distance."""

    def notices(self, scene: Scene) -> Tensor:
        """See the base class."""
        enters = scene.beside / scene.inward.clamp_min(NEAR_ZERO)
        passes = (scene.gap + 2.0 * VEHICLE_LENGTH) / scene.closing.clamp_min(NEAR_ZERO)
        comes = (scene.inward > 0.0) & (scene.closing > 0.0) & (enters <= passes + scene.dt)
        return (scene.beside <= 0.0) | comes

    def wanted(self, scene: Scene) -> Tensor:
        """See the base class."""
        b, hard, critical = self.comfortable_braking, self.hard_braking, self.critical(scene)
        return torch.where(critical > 0.0, b + critical * (hard - b), self.proactive(scene) * b)

    def proactive(self, scene: Scene) -> Tensor:
        """Return the proactive fuzzy safety PFS, from 0 to 1, (B, V)."""
        v, lead = scene.own_speed, scene.speed.square() / (2.0 * self.lead_braking)
        start = v * self.reaction_time - lead
        safe = start + v.square() / (2.0 * self.comfortable_braking) + self.margin
        return _membership(scene.gap - self.margin, safe, start + v.square() / (2.0 * self.hard_braking))

    def critical(self, scene: Scene) -> Tensor:
        """Return the critical fuzzy safety CFS, from 0 to 1, (B, V)."""
        r, a = self.reaction_time, scene.own_acceleration.clamp_min(-self.comfortable_braking)
        way, later = (scene.closing + a * r / 2.0) * r, scene.closing + a * r
        safe = way + later.square() / (2.0 * self.comfortable_braking)
        near = _membership(scene.gap, safe, way + later.square() / (2.0 * self.hard_braking))
        slows = scene.closing.square() / (2.0 * scene.own_acceleration.abs()).clamp_min(NEAR_ZERO)
        soon = torch.where(later < 0.0, (scene.gap < slows).to(near.dtype), near)
        return torch.where(scene.closing > 0.0, soon, 0.0)


def _membership(gap: Tensor, safe: Tensor, unsafe: Tensor) -> Tensor:
    """Return 0 for gaps from `safe` on, 1 up to `unsafe`, linear in between, (B, V)."""
    between = (safe - gap) / (safe - unsafe).clamp_min(NEAR_ZERO)
    return torch.where(gap > safe, 0.0, between.clamp(0.0, 1.0))


class _Memory(NamedTuple):
    """Memory of B drivers between two ticks, V other vehicles."""

    y: Tensor
    """Of the others a tick ago [m], (B, V)."""
    speeds: Tensor
    """Of the others a tick ago [m/s], (B, V)."""
    noticed: Tensor
    """Ticks for which each vehicle has been noticed, forgotten as fast, int64, (B, V)."""
    waited: Tensor
    """Ticks of danger so far, int64, (B,)."""
    acceleration: Tensor
    """The last one [m/s^2], (B,)."""
    planned: tuple[Tensor, ...]
    """Accelerations of the improved IDM [m/s^2] up to a reaction time ago, the oldest first, (B,) each."""
    initial_speed: Tensor
    """Own speed at the start [m/s], (B,)."""


@dataclass(frozen=True)
class ReferenceDriver:
    """A reference driver in a world."""

    model: ReferenceModel
    world: World
    recordable: ClassVar[bool] = True
    """Whether its operations may be recorded: nothing about it changes."""

    @cached_property
    def following(self) -> IDM:
        """The car-following model between dangers, whose desired speed is the initial one."""
        return replace(ATTENTIVE_IDM, time_headway=self.model.time_headway, max_deceleration=CRUISE_BRAKING)

    def act(self, episode: Episode, memory: Any) -> tuple[Tensor, Any]:
        """Brake for dangers, else follow or keep the speed; see `Driver`."""
        model, dt, state = self.model, self.world.clock.dt, episode.state
        memory = self._begin(episode) if memory is None else memory
        scene, ahead = self._look(episode, memory)
        notices, evaluation = model.notices(scene) & ahead, _ticks(model.evaluation_time, dt)
        wanted = torch.where(notices & (memory.noticed >= evaluation), model.wanted(scene), 0.0).amax(dim=1)
        danger, delay = wanted > 0.0, _ticks(model.reaction_time, dt)
        planned = (*memory.planned, self._follow(episode, memory, scene))[-delay - 1 :]
        cruise = planned[0]
        harder = (-memory.acceleration).clamp_min(0.0) + model.jerk * dt
        braking = torch.minimum(wanted.clamp_max(model.max_braking), harder)
        answer = torch.where(memory.waited >= delay, -braking, -model.release)
        acceleration = torch.where(danger, torch.minimum(cruise, answer), cruise)
        _, y, heading, speed = state.vehicles[0]
        action = torch.stack((acceleration, lane_keeping(y, heading, speed, episode.road)), dim=1)
        return action, memory._replace(
            y=state.y[:, 1:],
            speeds=state.speed[:, 1:],
            noticed=(memory.noticed + torch.where(notices, 1, -1)).clamp(0, 2 * evaluation),
            waited=memory.waited + danger,
            acceleration=acceleration,
            planned=planned,
        )

    def _begin(self, episode: Episode) -> _Memory:
        """Return the memory at time 0: vehicles of the driver's lane are known, and speeds have been kept."""
        state, nothing = episode.state, torch.zeros_like(episode.state.speed[:, 0])
        speed, lane = state.speed[:, 1:], episode.road.centre_of(state.y[:, :1])
        y = state.y[:, 1:] - speed * torch.sin(state.heading[:, 1:]) * self.world.clock.dt
        known = (state.y[:, 1:] - lane).abs() <= episode.road.width / 2
        noticed = known.long() * _ticks(self.model.evaluation_time, self.world.clock.dt)
        kept = state.speed[:, 0].clamp_min(SLOWEST)
        waited = torch.zeros_like(nothing, dtype=torch.int64)
        return _Memory(y, speed, noticed, waited, nothing, (), kept)

    def _look(self, episode: Episode, memory: _Memory) -> tuple[Scene, Tensor]:
        """Return what there is to see, and which vehicles are ahead, by their centres, boolean (B, V)."""
        state, dt = episode.state, self.world.clock.dt
        own_y, own_speed = state.y[:, :1], state.speed[:, :1]
        speed, moved = state.speed[:, 1:], state.y[:, 1:] - memory.y
        along = speed * torch.cos(state.heading[:, 1:] - state.heading[:, :1])
        x, y = state.x[:, 1:] - state.x[:, :1] + (along - own_speed) * dt, state.y[:, 1:] + moved
        scene = Scene(
            gap=x - VEHICLE_LENGTH,
            beside=(y - own_y).abs() - VEHICLE_WIDTH,
            offset=(y - episode.road.centre_of(own_y)).abs(),
            inward=-moved * (state.y[:, 1:] - own_y).sign() / dt,
            speed=along,
            braking=(memory.speeds - speed) / dt,
            own_speed=own_speed,
            own_acceleration=memory.acceleration[:, None],
            lane_width=episode.road.width,
            dt=dt,
        )
        return scene, x >= 0.0

    def _follow(self, episode: Episode, memory: _Memory, scene: Scene) -> Tensor:
        """Return the acceleration between dangers, behind the nearest vehicle of the own lane [m/s^2], (B,)."""
        speed = episode.state.speed[:, 0]
        if not self.model.cruise:
            return torch.zeros_like(speed)
        ahead = find_ahead(episode.state, scene.in_lane, memory.speeds, scene.dt)
        lead = Lead(ahead.gap, speed - ahead.speed)
        return improved_acceleration(
            self.following, speed, lead, ahead.acceleration.clamp_max(0.0), desired_speed=memory.initial_speed
        )


def _ticks(time: float, dt: float) -> int:
    """Return the ticks after which a time [s] is over."""
    return math.ceil(time / dt - 1e-9)


@dataclass(frozen=True)
class ReferenceEgo:
    """A reference driver; a `DrivingProblem` turns it into a driver of its world."""

    model: ReferenceModel
    """Its parameters."""

    def noise_columns(self, world: World) -> int:
        """Return how many columns of x are its noise in a world: none."""
        return 0

    def in_world(self, world: World) -> ReferenceDriver:
        """Return the driver that it is in a world."""
        return ReferenceDriver(self.model, world)


REFERENCE_EGOS: Final[Mapping[str, ReferenceEgo]] = MappingProxyType(
    {
        "cc_human": ReferenceEgo(CarefulHuman()),
        "alks": ReferenceEgo(LaneKeepingSystem()),
        "fsm": ReferenceEgo(FuzzySafety()),
        "rss": ReferenceEgo(ResponsibilitySensitive()),
    }
)
"""The reference drivers by name."""
