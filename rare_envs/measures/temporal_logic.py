"""Signal temporal logic: the robustness of a formula over an episode, by rtamt (the extra `stl`).

References:
    Donze and Maler, "Robust satisfaction of temporal logic over real-valued signals", 2010; Nickovic and Yamaguchi,
    "RTAMT: online robustness monitors from STL", 2020.
"""

import logging
import re
import warnings
from collections.abc import Callable
from functools import partial
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from rare_envs.measures.base import Moment, Trace, TraceMeasure
from rare_envs.measures.longitudinal import drac, thw, ttc
from rare_envs.measures.two_dimensional import clearance
from rare_envs.plugins import did_you_mean
from rare_envs.startup import advise_install

ROBUSTNESS_MAX = 1e6
"""Robustness is cut here, where a formula says nothing of the signals."""

SIGNALS: MappingProxyType[str, Callable[[Moment], Tensor]] = MappingProxyType(
    {
        "gap": lambda moment: moment.lead.gap.clamp(max=1000.0),
        "closing_speed": lambda moment: moment.lead.closing_speed,
        "lead_speed": lambda moment: moment.state.speed[:, 0] - moment.lead.closing_speed,
        "speed": lambda moment: moment.state.speed[:, 0],
        "acceleration": lambda moment: moment.acceleration[:, 0],
        "heading": lambda moment: moment.state.heading[:, 0],
        "lane_offset": lambda moment: moment.state.y[:, 0] - moment.road.centre_of(moment.state.y[:, 0]),
        "edge": lambda moment: (
            moment.road.lanes * moment.road.width / 2 - (moment.state.y[:, 0] - moment.road.middle).abs()
        ),
        "ttc": ttc,
        "thw": thw,
        "drac": drac,
        "clearance": clearance,
    }
)
"""Signals of the ego that a formula may name, in SI units: gap to the lead (at most 1000), closing speed, speed of the
lead (the ego's, without one), speed, acceleration, heading relative to the road, offset to the right of the lane's
middle, way from the ego's centre to the edge of the road, and measures."""
_OF_VEHICLE = re.compile(r"(x|y|heading|speed)_(\d+)")
_NAME = re.compile(r"[A-Za-z_]\w*")


def stl(formula: str) -> TraceMeasure:
    """Return the robustness of a formula of signal temporal logic over the episode: by how much it holds at its start.

    Negative where the formula is violated, so f <= 0 counts episodes that violate it (or just hold it), and a collision
    counts only if the formula speaks of it, as "always (clearance > 0)" does not quite: its signal is over 0 until
    contact. `with_collision(stl(...), -100)` has collisions fail with any formula.

    Args:
        formula: In rtamt's language, such as "always (gap > 2)" or "always[0:5] (ttc > 1.5 or speed < 3)"; times in s.
            Names: `SIGNALS`, and x_1, y_1, heading_1, speed_1 and so on of every vehicle, 0 being the ego.

    Raises:
        ValueError: If it does not parse or names an unknown signal.
        ImportError: If rtamt is not installed.

    Example:
        >>> import rare_envs
        >>> measure = stl("always (gap > 2)")  # doctest: +SKIP
        >>> rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", measure=measure)  # doctest: +SKIP
    """
    _parse(formula, 1e-3)
    return TraceMeasure(partial(robustness, formula), collision=None)


def robustness(formula: str, trace: Trace) -> Tensor:
    """Return the robustness of a formula in the B episodes of a trace, shape (B,)."""
    monitor, names = _parse(formula, trace.dt)
    columns = {name: _signal(trace, name).T.tolist() for name in names}
    ticks = [trace.dt * k for k in range(len(trace.valid))]
    found = []
    for row in range(trace.valid.shape[1]):
        found.append(monitor.evaluate({"time": ticks, **{name: columns[name][row] for name in names}})[0][1])
    values = torch.tensor(found, dtype=trace.state.x.dtype, device=trace.state.x.device)
    return values.clamp(-ROBUSTNESS_MAX, ROBUSTNESS_MAX)


def _signal(trace: Trace, name: str) -> Tensor:
    """Return one signal, shape (T, B)."""
    if name in SIGNALS:
        return trace.of(SIGNALS[name])
    field, _, vehicle = name.rpartition("_")
    values: Tensor = getattr(trace.state, field)  # a field of State by its name, which the formula gives
    if int(vehicle) >= values.shape[2]:
        raise ValueError(f"The formula names {name!r}, but the vehicles are 0 to {values.shape[2] - 1}.")
    return values[:, :, int(vehicle)]


def _parse(formula: str, dt: float) -> tuple[Any, list[str]]:
    """Return a monitor for a formula, and the signals that it names."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the parser that it uses
            import rtamt
    except ImportError as error:
        raise ImportError(
            f"Signal temporal logic needs rtamt, on Python 3.11 or earlier: {advise_install('stl')}."
        ) from error
    if not isinstance(formula, str):
        raise ValueError(f"Expected a formula such as 'always (gap > 2)', got {formula!r}.")
    names = [name for name in dict.fromkeys(_NAME.findall(formula)) if name in SIGNALS or _OF_VEHICLE.fullmatch(name)]
    monitor = rtamt.StlDiscreteTimeOfflineSpecification()
    for name in names:
        monitor.declare_var(name, "float")
    monitor.spec = formula
    monitor.set_sampling_period(dt, "s", 0.1)
    level = logging.root.manager.disable
    logging.disable(logging.WARNING)  # of what is raised as an error here
    try:
        monitor.parse()
    except KeyError as error:
        unknown = str(error.args[0])
        raise ValueError(
            f"The formula names an unknown signal {unknown!r}{did_you_mean(unknown, SIGNALS)}; the signals are "
            f"{', '.join(SIGNALS)}, and x_0, y_0, heading_0, speed_0 and so on of every vehicle."
        ) from error
    except rtamt.RTAMTException as error:
        raise ValueError(f"The formula {formula!r} does not parse: {error}") from error
    finally:
        logging.disable(level)
    if len(monitor.ast.specs) != 1:
        raise ValueError(f"Expected one formula, got {len(monitor.ast.specs)} in {formula!r}; join them with 'and'.")
    return monitor, names
