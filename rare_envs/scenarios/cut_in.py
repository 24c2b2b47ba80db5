"""Cut-in: a vehicle moves into the gap between the ego and its lead along a cubic Bezier (Tian et al. 2024, Fig. 4).

Two versions. In `CutIn-v1` the cutter drives as people do (`CutterModel`): it lets the gap to its new lead grow as they
do, turns back while the place beside it is taken or the ego behind would have to brake hard for it, and rarely has not
looked. The cutter of `CutIn-v0` is a script of Tian et al.'s that nobody drives like: at the start it brakes for its
new lead by 4.2 m/s^2 (US 101) and 4.9 (I-80) in the median, where recorded cutters accelerate by 0.26 and 0.08, and it
moves into whoever is beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import torch
from scipy.special import ndtri
from torch import Tensor

from rare_envs.control.human_driver import ATTENTIVE_IDM
from rare_envs.control.idm import COOLNESS, IDM, check_numbers, improved_acceleration
from rare_envs.devices import scalars
from rare_envs.distributions.space import Parameter
from rare_envs.scenarios.base import SPEED_RANGE, Others, Scenario, base_files, columns
from rare_envs.scenarios.hard_brake import PARABOLA, lost_share
from rare_envs.traffic.bodies import Lead
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import LANE_WIDTH, NEAR_ZERO, VEHICLE_LENGTH, VEHICLE_WIDTH, State

CUT_IN_DURATION = 4.0
"""Duration of the lane change where x has no column for it [s]."""
CUT_IN_MIN_LENGTH = 15.0
"""Least length of the path along the road [m], for slow vehicles, which cannot move sideways."""
CUTTER_IDM = IDM()
"""How the cutter of `CutIn-v0` follows the lead; its desired speed is its own initial speed."""


def _start(x: Tensor) -> State:
    """Place ego and lead in one lane and the cutter beside them, by the first six columns of x; theta is empty."""
    ego_speed, cut_in_speed, lead_speed, cut_in_gap, lead_gap, lateral_offset = x[:, :6].unbind(dim=1)
    zero = torch.zeros_like(ego_speed)
    cutter_x = cut_in_gap + VEHICLE_LENGTH
    return State(
        x=columns(zero, cutter_x, cutter_x + lead_gap + VEHICLE_LENGTH),
        y=columns(zero, lateral_offset, zero),
        heading=columns(zero, zero, zero),
        speed=columns(ego_speed, cut_in_speed, lead_speed),
        theta=x[:, :0],
    )


def initial(x: Tensor) -> State:
    """Place ego and lead in one lane and the cutter beside them.

    x is as in `CUT_IN`. Columns of theta: start of the cutter's path [m], its length (its way in 4 s at its initial
    speed) [m], lateral offset [m], the cutter's desired speed [m/s].
    """
    state = _start(x)
    length = (x[:, 1] * CUT_IN_DURATION).clamp(min=CUT_IN_MIN_LENGTH)
    return state._replace(theta=columns(state.x[:, 1], length, x[:, 5], x[:, 1].clamp(min=1.0)))


def bezier(progress: Tensor, length: Tensor, offset: Tensor) -> tuple[Tensor, Tensor]:
    """Return y [m] and slope of the cubic Bezier from (0, offset) to (length, 0), level at both ends, (B,) each.

    With t = progress / length, y = offset (1 - 3 t^2 + 2 t^3); before and after it straight on.
    """
    one, two, three, six = scalars((1.0, 2.0, 3.0, 6.0), progress)
    t = (progress / length).clamp(0.0, 1.0)
    y = offset * (one + t * t * (two * t - three))
    slope = offset * (six * t * (t - one)) / length
    return y, slope


def others(state: State, dt: float) -> Others:
    """Move the lead at its speed and the cutter on its path, with IDM's acceleration behind the lead.

    Tian et al.'s code steers along a Bezier of 30 m by pure pursuit, with the ego's IDM; here it is on the curve.
    """
    (x, _, heading, speed), (lead_x, _, _, lead_speed) = state.vehicles[1:]
    tick, body = scalars((dt, VEHICLE_LENGTH), x)
    lead = Lead(lead_x - x - body, speed - lead_speed * torch.cos(heading))
    acceleration = CUTTER_IDM.acceleration(speed, lead, state.theta[:, 3])
    return _advance(state, (speed + acceleration * tick).clamp_min(0.0), lead_speed, dt)


def driven(state: State, action: Tensor, dt: float) -> Others:
    """Move both with the accelerations of their drivers, the cutter on its path, the lead in its lane."""
    speed = (state.speed[:, 1:] + action[..., 0] * dt).clamp(min=0.0)
    return _advance(state, speed[:, 0], speed[:, 1], dt)


def _advance(state: State, speed: Tensor, lead_speed: Tensor, dt: float) -> Others:
    """Return both after the tick: the cutter on its path, the lead straight on, with new speeds (B,)."""
    start, length, offset, _ = state.theta.unbind(dim=1)
    x, lead_x = _move_along(state, dt)
    y, slope = bezier(x - start, length, offset)
    return _place(x, lead_x, y, torch.atan(slope), speed, lead_speed)


def _move_along(state: State, dt: float) -> tuple[Tensor, Tensor]:
    """Return where along the road cutter and lead are after a tick [m], (B,) each."""
    (x, _, heading, speed), (lead_x, _, _, lead_speed) = state.vehicles[1:]
    (tick,) = scalars((dt,), x)
    return x + speed * torch.cos(heading) * tick, lead_x + lead_speed * tick


def _place(x: Tensor, lead_x: Tensor, y: Tensor, heading: Tensor, speed: Tensor, lead_speed: Tensor) -> Others:
    """Return the cutter and the lead, in the middle of the ego's lane, from their columns (B,)."""
    zero = scalars((0.0,), x)[0].expand_as(x)
    table = torch.stack((x, lead_x, y, zero, heading, zero, speed, lead_speed))
    return Others(*table.view(4, 2, len(x)).mT.unbind(0))


CUT_IN = Scenario(
    name="cut_in",
    road=straight(2),
    vehicle_names=("ego", "cutter", "lead"),
    horizon=10.0,
    # Gaps as in car-following; a gap that a vehicle cuts into and that is longer than 120 m makes no cut-in. Lateral
    # offset: vehicles 2 m wide with at least 0.2 m between their sides, and at most one lane (4 m) plus half a metre
    # off-centre each.
    parameters=(
        Parameter("ego_speed", *SPEED_RANGE, "initial speed of the ego"),
        Parameter("cut_in_speed", *SPEED_RANGE, "initial speed of the vehicle that cuts in"),
        Parameter("lead_speed", *SPEED_RANGE, "speed of the lead in the ego's lane, which keeps it"),
        Parameter("cut_in_gap", "m", 1.0, 120.0, "initial gap from ego to cutter along the road"),
        Parameter("lead_gap", "m", 1.0, 150.0, "initial gap from cutter to lead along the road"),
        Parameter("lateral_offset", "m", 2.2, 5.0, "initial distance of the centres across"),
    ),
    bases=base_files("cut_in", "us101", "us101-15-offsets", "us101-closing", "i80", "i80-closing", "highway"),
    initial=initial,
    others=others,
    driven=driven,
)
"""`CutIn-v0`: Tian et al.'s script."""

UNSEEN_SHARE = 1.6e-4
"""Share of lane changes in which the driver has not looked: 44 / (3.219e6 km * 0.26 per km * 0.32).

It is calibrated by people's *own* changes: in 44 near-crashes of the 100-Car study the subject changed lanes and "did
not see other vehicle", in 3.219e6 km. US 101 has 0.26 changes per km; 0.32 of those without a look into its traffic,
onto a neighbour at a random time, are near-crashes of the model that stands (200,000 draws of the stratum, `human`). It
is 2.7 times as large in the thinner traffic of the 100-Car's events. The 136 near-crashes at cut-ins that subjects
*suffered* are another count and were not used. Every base may give it another share."""
ATTENTION_LIMIT: Final = float(ndtri(UNSEEN_SHARE))
"""Cutters with an `attention` below it have not looked."""


class CutInTheta(NamedTuple):
    """Columns of theta in `CutIn-v1`, (B,) each: parameters, and behind them the script's memory.

    Example:
        >>> from rare_envs.scenarios import find_scenario
        >>> x = torch.tensor([[20.0, 20.0, 20.0, -3.0, 50.0, 3.5, 4.0, *6 * [0.0]]])  # the cutter beside the ego
        >>> CutInTheta(*find_scenario("cut_in").initial(x).theta.unbind(1)).length.tolist()
        [80.0]
    """

    length: Tensor
    """Of the cutter's path along the road [m]."""
    offset: Tensor
    """Across it [m]."""
    desired_speed: Tensor
    """Of the cutter [m/s]."""
    delay: Tensor
    """Until who has not looked notices the ego, from the moment the body is over the line [s]: infinite for who never
    does, minus infinity for who has looked."""
    indicates: Tensor
    """1 with the indicator on, else 0."""
    lead_speed: Tensor
    """Initial speed of the lead [m/s]."""
    onset: Tensor
    """Time at which the lead begins to brake [s]."""
    lasting: Tensor
    """Duration of its braking [s]."""
    loss: Tensor
    """Its loss of speed in it [m/s]; 0 if it does not brake."""
    time: Tensor
    """Since the start [s]."""
    way: Tensor
    """Along the path, at most its length [m]."""
    waited: Tensor
    """Ticks for which the cutter has seen that the place is taken."""
    over: Tensor
    """Ticks since its body came over the line; -1 before."""
    turned: Tensor
    """1 if it has turned back by now, else 0."""


_RANGES: Final = {
    "from 0 to 1": ("oblivious", "indicating"),
    "of at least 0, finite": (
        "reaction_time",
        "most_braking",
        "margin",
        "noticing",
        "noticing_spread",
        "brakings_per_km",
    ),
    "above 0, finite": ("braking_window",),
}


@dataclass(frozen=True, kw_only=True)
class CutterModel:
    """A cutter that drives as people do, and its lead: what `CutIn-v1` is made of.

    Along: behind its new lead, or the ego where it drops in behind it, by the improved IDM with the
    constant-acceleration heuristic, for a lead that keeps its speed. Across: forward
    on the Bezier with progress speed cos(heading) dt / length, or back, a reaction time after the place was taken:
    while the ego is beside it, or is behind it and would have to brake by more than `most_braking`. It looks until it
    is in the lane. A cutter that has not looked checks nothing until it notices the ego, and then turns back at once.
    The lead keeps its speed, or brakes once in a parabola.

    Measured against recorded cutters from the same states (root mean square error of the mean acceleration over 2 s):
    0.55 m/s^2 on US 101 and 0.43 on I-80, where `CutIn-v0`'s script has 1.31 and 0.94.

    References:
        Kesting, Treiber and Helbing, "Enhanced intelligent driver model", 2010, the heuristic.
        Treiber and Kesting, "Traffic Flow Dynamics", 2013: braking for lane changes, as commonly quoted.
        Dingus et al., "The 100-Car Naturalistic Driving Study", 2006, events: who had not looked, and turned back.
        Olsen, "Modeling slow lead vehicle lane changing", 2003: indicators.

    Raises:
        ValueError: A parameter is negative, infinite or no number, a share or weight above 1, or there is no window.

    Example:
        >>> CutterModel(looks=False).scenario().name  # a cutter that never looks
        'cut_in'
    """

    looks: bool = True
    """Whether the cutter ever looks; without it nobody turns back or follows the ego, as in `CutIn-v0`."""
    idm: IDM = ATTENTIVE_IDM
    """a, b, T, s0 and hardest braking behind the lead: those of the human driver (Treiber and Kesting 2013, table 11.2;
    0.774 g of UN Regulation 157). So is v0, or the initial speed where that is higher: recorded cutters behind faster
    leads accelerate (0.46 m/s^2 in the mean of 16 starts on US 101, 0.39 of 21 on I-80), which who wishes for no more
    than the initial speed does not; from all starts its errors are 0.69 and 0.53."""
    coolness: float | None = COOLNESS
    """Weight of the heuristic (Kesting et al. 2010, table 1); None for the IDM alone, as in `CutIn-v0`."""
    reaction_time: float = 0.6
    """From the place being taken to turning back [s], for who has looked. Assumed: the human driver's T'."""
    most_braking: float = 2.0
    """Largest deceleration that the cutter expects of the ego, closing^2 / (2 gap) [m/s^2]: Treiber and Kesting (2013);
    MOBIL (2007) has 4, with which contacts are twice as many."""
    margin: float = 0.5
    """The ego is beside the cutter up to this gap along the road [m]. Assumed."""
    noticing: float = 0.1
    """Median of the time from the body being over the line to noticing the ego, for who has not looked [s]. Times up to
    0.25 s agree with the 100-Car study: none of 44 subjects of its own changes and 58 of others' were touched."""
    noticing_spread: float = 0.3
    """Standard deviation of its logarithm. Assumed."""
    oblivious: float = 2.0 / 44.0
    """Share of those who have not looked that never notice: 2 of the 44 subjects of the 100-Car study."""
    indicating: float = 0.64
    """Share of changes with the indicator on from the start: Olsen (2003), 16 commuters."""
    brakings_per_km: float = 1.23
    """Brakings of the lead by 3 m/s or more: 268 on 218 km of US 101. The base of `HardBrake-v0` is read from the same
    vehicles by rules that keep 283 on 219 km, 1.29 per km: 5 % more, within the error of such a count."""
    braking_window: float = 10.0
    """Its braking begins in the first so many seconds, at a uniform time [s]: an episode."""
    peak: tuple[float, float] = (0.730, 0.368)
    """Mean and standard deviation of the logarithm of the peak of its deceleration [m/s^2], of these 268 brakings; the
    283 have 0.765 and 0.359."""
    loss: tuple[float, float] = (1.572, 0.318)
    """The same of its loss of speed [m/s], which is at most its speed; the 283 have 1.561 and 0.320. The correlation of
    0.32 is left out."""

    def __post_init__(self) -> None:
        check_numbers(self, "cutter", _RANGES)
        if self.coolness is not None:
            check_numbers(self, "cutter", {"from 0 to 1": ("coolness",)})
        for name in ("peak", "loss"):
            value = getattr(self, name)
            if len(value) != 2 or not all(map(math.isfinite, value)) or value[1] < 0.0:
                wanted = "a finite mean and a standard deviation of at least 0"
                raise ValueError(f"Expected {name} of the cutter to be {wanted}, got {value!r}.")

    def scenario(self) -> Scenario:
        """Return the scenario with this cutter."""
        return replace(
            CUT_IN,
            parameters=(*_CUT_IN_PARAMETERS, *_DRIVER_PARAMETERS),
            bases=base_files("cut_in_v1", "us101", "i80", "us101-test"),
            initial=self.initial,
            others=self.others,
            driven=self.driven,
            signals=signals,
            evades=evades,
        )

    def initial(self, x: Tensor) -> State:
        """Place ego and lead in one lane and the cutter beside them; columns of theta as in `CutInTheta`."""
        cut_in_speed, lead_speed, offset = x[:, 1], x[:, 2], x[:, 5]
        duration, attention, noticing, indicator, braking, peak, loss = x[:, 6:].unbind(dim=1)
        (limit, oblivious, indicating) = scalars(
            (ATTENTION_LIMIT, float(ndtri(self.oblivious)), float(ndtri(1.0 - self.indicating))), x
        )
        delay = self.noticing * torch.exp(self.noticing_spread * noticing)
        delay = torch.where((noticing < oblivious) | (not self.looks), math.inf, delay)
        delay = torch.where((attention < limit) | (not self.looks), delay, -math.inf)
        chance = (lead_speed * (self.brakings_per_km / 1000.0 * self.braking_window)).clamp_max(1.0)
        rank = torch.special.ndtr(braking) / chance.clamp_min(1e-6)
        peak = torch.exp(self.peak[0] + self.peak[1] * peak)
        loss = torch.minimum(torch.exp(self.loss[0] + self.loss[1] * loss), lead_speed)
        zero, brakes = torch.zeros_like(offset), (rank < 1.0) & (chance > 0.0) & (loss > 0.0)
        state = _start(x)
        theta = CutInTheta(
            length=(cut_in_speed * duration).clamp(min=CUT_IN_MIN_LENGTH),
            offset=offset,
            desired_speed=cut_in_speed.clamp(min=self.idm.desired_speed),
            delay=delay,
            indicates=(indicator > indicating).to(x.dtype),
            lead_speed=lead_speed,
            onset=self.braking_window * rank.clamp(max=1.0),
            lasting=torch.where(brakes, PARABOLA * loss / peak, 1.0),
            loss=torch.where(brakes, loss, zero),
            time=zero,
            way=zero,
            waited=zero,
            over=zero - 1.0,
            turned=zero,
        )
        return state._replace(theta=columns(*theta))

    def others(self, state: State, dt: float) -> Others:
        """Move the lead, which keeps its speed or brakes once, and the cutter behind and in front of it."""
        theta = CutInTheta(*state.theta.unbind(dim=1))
        (tick,), speed, lead = scalars((dt,), state.x), state.vehicles[1].speed, self._find_lead(state)
        if self.coolness is None:
            acceleration = self.idm.acceleration(speed, lead, theta.desired_speed)
        else:
            wanted, coolness = theta.desired_speed, self.coolness
            acceleration = improved_acceleration(self.idm, speed, lead, desired_speed=wanted, coolness=coolness)
        after = theta.lead_speed - theta.loss * lost_share(theta.time + tick - theta.onset, theta.lasting)
        return self._advance(state, theta, (speed + acceleration * tick).clamp_min(0.0), after, dt)

    def driven(self, state: State, action: Tensor, dt: float) -> Others:
        """Move both with the accelerations of their drivers; across the cutter goes on and turns back by itself."""
        speed = (state.speed[:, 1:] + action[..., 0] * dt).clamp(min=0.0)
        return self._advance(state, CutInTheta(*state.theta.unbind(dim=1)), speed[:, 0], speed[:, 1], dt)

    def _find_lead(self, state: State) -> Lead:
        """Return who the cutter follows: its new lead, or the ego where it drops in behind it."""
        ego, cutter, lead = state.vehicles
        (body,) = scalars((VEHICLE_LENGTH,), cutter.x)
        gap, gap_to_ego = lead.x - cutter.x - body, ego.x - cutter.x - body
        behind = (gap_to_ego >= 0.0) & (gap_to_ego < gap) & ((ego.y - cutter.y).abs() < self.reach_across)
        speed = torch.where(behind, ego.speed, lead.speed) * torch.cos(cutter.heading)
        return Lead(torch.where(behind, gap_to_ego, gap), cutter.speed - speed)

    @property
    def reach_across(self) -> float:
        """Distance of centres across within which the ego ahead is followed [m]: a body in the other's lane."""
        return OVER_THE_LINE if self.looks else 0.0

    def ticks_to_turn(self, dt: float) -> float:
        """Return the reaction time in ticks of dt [s]."""
        return float(round(self.reaction_time / dt))

    def _advance(self, state: State, theta: CutInTheta, speed: Tensor, lead_speed: Tensor, dt: float) -> Others:
        """Return both after the tick with new speeds (B,): the cutter on its path or on the way back."""
        x, lead_x = _move_along(state, dt)
        theta, back = self._decide(state, theta, dt)
        (tick,), (_, _, heading, old_speed) = scalars((dt,), x), state.vehicles[1]
        ahead = old_speed * torch.cos(heading) * tick
        way = theta.way + torch.where(back, -ahead, ahead)
        way = torch.minimum(way.clamp_min(0.0), theta.length)
        y, slope = bezier(way, theta.length, theta.offset)
        heading = torch.atan(torch.where(back, -slope, slope))
        theta = theta._replace(time=theta.time + tick, way=way)
        return _place(x, lead_x, y, heading, speed, lead_speed)._replace(theta=columns(*theta))

    def _decide(self, state: State, theta: CutInTheta, dt: float) -> tuple[CutInTheta, Tensor]:
        """Return what the cutter remembers after it has looked or not, and whether it goes back, boolean (B,)."""
        ego, cutter = state.vehicles[:2]
        (tick,) = scalars((dt,), cutter.x)
        distance = cutter.x - ego.x
        beside = distance.abs() < VEHICLE_LENGTH + self.margin
        gap, closing = distance - VEHICLE_LENGTH, (ego.speed - cutter.speed).clamp_min(0.0)
        pressed = (gap >= 0.0) & (closing.square() / (2.0 * gap.clamp_min(NEAR_ZERO)) > self.most_braking)
        over = torch.where(theta.over < 0.0, torch.where(cutter.y < OVER_THE_LINE, 0.0, theta.over), theta.over + 1.0)
        crossing, sees = theta.way < theta.length, over * tick >= theta.delay
        taken = crossing & sees & (beside | pressed)
        patience = torch.where(torch.isneginf(theta.delay), self.ticks_to_turn(dt), 0.0)
        back = taken & (theta.waited >= patience)
        waited = torch.where(taken, theta.waited + 1.0, 0.0)
        turned = torch.where(back, 1.0, theta.turned)
        return theta._replace(waited=waited, over=over, turned=turned), back


OVER_THE_LINE = LANE_WIDTH / 2 + VEHICLE_WIDTH / 2
"""The cutter's body is over the line where its centre is nearer than this to the middle of the ego's lane [m]."""


def signals(state: State) -> Tensor:
    """Return which of cutter and lead have their indicator on towards the ego's lane, boolean, (B, 2): no lead."""
    theta = CutInTheta(*state.theta.unbind(dim=1))
    on = (theta.indicates > 0.0) & (theta.way < theta.length)
    return torch.stack((on, torch.zeros_like(on)), dim=1)


def evades(state: State) -> Tensor:
    """Return whether the cutter, not having looked, has turned back by now, boolean, (B,)."""
    theta = CutInTheta(*state.theta.unbind(dim=1))
    return (theta.turned > 0.0) & ~torch.isneginf(theta.delay)


_CUT_IN_PARAMETERS = (
    *CUT_IN.parameters[:2],
    Parameter("lead_speed", *SPEED_RANGE, "initial speed of the lead in the ego's lane"),
    # a cutter that has not looked begins beside the ego too
    Parameter("cut_in_gap", "m", -10.0, 120.0, "initial gap from ego to cutter along the road"),
    *CUT_IN.parameters[4:],
    # Below 1.5 s a change by a lane of 3.5 m needs more than 9.3 m/s^2 across (6 offset / duration^2), which tyres do
    # not give, and of 390 recorded changes none is shorter than 2.3 s; two over 12 s are left out.
    Parameter("duration", "s", 1.5, 12.0, "time of the lane change at the initial speed"),
)
_DRIVER_PARAMETERS = tuple(
    Parameter(name, "", -math.inf, math.inf, meaning)
    for name, meaning in (
        ("attention", f"standard normal; the cutter has not looked below {ATTENTION_LIMIT:.3f}"),
        ("noticing", "standard normal; how late a cutter notices that has not looked, never below -1.691"),
        ("indicator", "standard normal; the cutter's indicator is on above -0.358"),
        ("lead_braking", "standard normal; when the lead brakes, not at all above what its speed allows"),
        ("lead_peak", "standard normal; logarithm of the peak of its deceleration"),
        ("lead_loss", "standard normal; logarithm of its loss of speed"),
    )
)
CUTTER = CutterModel()
"""The cutter of `CutIn-v1`."""
CUT_IN_V1 = CUTTER.scenario()
"""`CutIn-v1`."""
