"""Braking: how hard the ego has to brake for its lead, and how long it can wait."""

import torch
from torch import Tensor

from rare_envs.control.actions import MAX_ACCELERATION
from rare_envs.measures.moment import STILL, Moment, acceleration_of_lead, gap_of
from rare_envs.measures.time_to_collision import TTC_MAX
from rare_envs.traffic.vehicle_models import STANDARD_GRAVITY

MAX_BRAKING = MAX_ACCELERATION
"""The hardest braking that an action can ask for [m/s^2]."""
RAPID_BRAKING, RAPID_LATERAL = 0.5 * STANDARD_GRAVITY, 0.4 * STANDARD_GRAVITY
"""Braking and lateral acceleration above which a manoeuvre is rapid [m/s^2]; see `evasive_manoeuvre`."""
DECELERATION_MAX = 100.0
"""Cap of decelerations [m/s^2], ten times what tyres can do: with a centimetre left they would be in the thousands."""


def drac(moment: Moment) -> Tensor:
    """Return the deceleration rate to avoid a crash (DRAC): it just reaches the lead's speed when the gap is used up.

    closing speed^2 / (2 gap) while closing, else 0; the lead keeps its speed.

    Critical value: 3.4 m/s^2, the deceleration that most drivers find comfortable (AASHTO, 2004).

    Args:
        moment: Of B scenarios.

    Returns:
        Deceleration [m/s^2], in [0, DECELERATION_MAX], shape (B,).

    References:
        Almqvist, Hyden and Risser, "Use of speed limiters in cars for increased safety and a better environment",
        Transportation Research Record 1318, 1991; Archer, "Indicators for traffic safety assessment and prediction",
        2005.

    Example:
        >>> from rare_envs.measures import Moment
        >>> drac(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()
        2.0
    """
    closing = moment.lead.closing_speed.clamp(min=0.0)
    return (closing.square() / (2.0 * gap_of(moment))).clamp(max=DECELERATION_MAX)


def required_deceleration(moment: Moment) -> Tensor:
    """Return the least constant deceleration with which the ego never reaches a lead of constant acceleration.

    With b the deceleration of the lead over the last tick (b = 0 where it speeds up), v the ego's speed, w the lead's
    and dv = v - w, two cases. The speeds become equal while the lead still moves: b + dv^2 / (2 gap). The lead stops
    first, if 2 gap / dv > w / b or dv <= 0: v^2 / (2 (gap + w^2 / (2 b))). If b = 0 it is `drac`.

    Critical values: 3.4 m/s^2 is comfortable, above 8 m/s^2 a dry road gives no more.

    Args:
        moment: Of B scenarios.

    Returns:
        Deceleration [m/s^2], in [0, DECELERATION_MAX], shape (B,).

    References:
        Jansson, "Collision avoidance theory with application to automotive collision mitigation", 2005 (the first case,
        as the required longitudinal acceleration).

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=20.0)
        >>> faster = moment.state.speed + torch.tensor([0.0, 0.4])  # the lead brakes by 4 m/s^2
        >>> before = moment.state._replace(speed=faster)
        >>> round(required_deceleration(moment._replace(before=before)).item(), 2)  # 20^2 / (2 (25 + 20^2 / 8))
        2.67
    """
    gap, dv, speed = gap_of(moment), moment.lead.closing_speed, moment.state.speed[:, 0]
    lead_speed = (speed - dv).clamp(min=0.0)
    braking = (-acceleration_of_lead(moment)).clamp(min=0.0)
    rolling = braking + dv.clamp(min=0.0).square() / (2.0 * gap)
    # the ways are compared crosswise, without a division by what may be 0
    stops_first = (braking > 0) & ((dv <= 0) | (2.0 * gap * braking > lead_speed * dv))
    way = gap + lead_speed.square() / (2.0 * torch.where(stops_first, braking, 1.0))
    required = torch.where(stops_first, speed.square() / (2.0 * way), rolling)
    return required.clamp(max=DECELERATION_MAX)


def evasive_manoeuvre(moment: Moment) -> Tensor:
    """Return how rapid the ego's evasive manoeuvre is: 1 and more makes a near-crash in the 100-Car study.

    The greater of its braking over 0.5 g and its lateral acceleration, beyond that of the road's curve, over 0.4 g.
    In the words of the study a near-crash is "any circumstance that requires a rapid, evasive maneuver by the subject
    vehicle, or any other vehicle, pedestrian, cyclist, or animal to avoid a crash"; "general guideline: subject vehicle
    braking greater than 0.5 g or steering input that results in a lateral acceleration greater than 0.4 g to avoid a
    crash constitutes a rapid maneuver". Here only the ego counts, and all its braking.

    Critical value: 1.

    Args:
        moment: Of B scenarios.

    Returns:
        Without unit, in [0, DECELERATION_MAX / RAPID_BRAKING], shape (B,); 0 at the start.

    References:
        Virginia Tech Transportation Institute, "Researcher dictionary for video reduction data", version 1.3, 2012
        (variable 5), of the 100-Car study: Dingus et al., DOT HS 810 593, 2006.

    Example:
        >>> from rare_envs.measures import Moment
        >>> moment = Moment.of_two(gap=25.0, speed=20.0, lead_speed=20.0)
        >>> before = moment.state._replace(speed=moment.state.speed + torch.tensor([0.6, 0.0]))
        >>> round(evasive_manoeuvre(moment._replace(before=before)).item(), 2)  # braked by 6 m/s^2
        1.22
    """
    braking = -moment.acceleration[:, 0]
    turned = torch.zeros_like(braking)
    if moment.before is not None:
        turned = (moment.state.heading - moment.before.heading)[:, 0] / moment.dt
    lateral = (moment.state.speed[:, 0] * turned).abs()
    rapid = torch.maximum(braking / RAPID_BRAKING, lateral / RAPID_LATERAL)
    return rapid.clamp(0.0, DECELERATION_MAX / RAPID_BRAKING)


def btn(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the brake threat number (BTN): the required deceleration as a share of what the brakes can do.

    Critical value: 1, above which braking alone cannot prevent the collision.

    Args:
        moment: Of B scenarios.
        brakes: The hardest braking of the ego [m/s^2].

    Returns:
        Brake threat number, in [0, DECELERATION_MAX / brakes], shape (B,).

    References:
        Jansson, "Collision avoidance theory with application to automotive collision mitigation", 2005.

    Example:
        >>> from rare_envs.measures import Moment
        >>> round(btn(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item(), 3)  # 2 of 5 m/s^2
        0.4
    """
    return required_deceleration(moment) / brakes


def ttb(moment: Moment, brakes: float = MAX_BRAKING) -> Tensor:
    """Return the time to brake (TTB): how long the ego can wait until it must brake fully for its lead.

    The lead keeps its speed.

    gap / closing speed - closing speed / (2 brakes). Negative past the point of no return: by how much it is too late.

    Critical value: 0, the point of no return.

    Args:
        moment: Of B scenarios.
        brakes: The hardest braking of the ego [m/s^2].

    Returns:
        Time to brake [s], in (-TTC_MAX, TTC_MAX], shape (B,).

    References:
        Hillenbrand, Spieker and Kroschel, "A multilevel collision mitigation approach: its situation assessment,
        decision making, and performance tradeoffs", IEEE Transactions on Intelligent Transportation Systems 7, 2006.

    Example:
        >>> from rare_envs.measures import Moment
        >>> ttb(Moment.of_two(gap=25.0, speed=20.0, lead_speed=10.0)).item()  # 25 / 10 - 10 / (2 5)
        1.5
    """
    closing = moment.lead.closing_speed.clamp(min=STILL)
    return (gap_of(moment) / closing - closing / (2.0 * brakes)).clamp(-0.99 * TTC_MAX, TTC_MAX)
