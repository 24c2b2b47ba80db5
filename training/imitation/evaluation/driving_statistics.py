"""Driving statistics: sums over the behaviour in recorded scenes, by scene: rates, histograms, squared errors."""

from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rare_envs.sensors.lidar import MAX_RANGE
from samplers.problem import FloatArray
from training.data.trajectories import DT
from training.imitation.evaluation.behaviour import HARD_BRAKE_ACCELERATION, Behaviour
from training.imitation.evaluation.prediction_error import Errors

BINS = MappingProxyType(
    {
        "speed": (0.0, 30.0, 60),
        "acceleration": (-5.0, 4.0, 60),
        "jerk": (-12.0, 12.0, 60),
        "yaw_rate": (-0.12, 0.12, 60),
        "inverse_ttc": (-1.0, 1.0, 60),
        "gap": (0.0, 100.0, 50),
    }
)
"""Lowest and highest edge and number of bins of each quantity; values beyond count in the outermost bin. Units are m/s,
m/s^2, m/s^3, rad/s, 1/s (closing speed over range of the beam ahead) and m (of that beam)."""
LEAST_RANGE = 0.1
"""Range of the beam ahead [m] to which shorter ones are raised before it divides the closing speed."""
ERROR_NAMES = ("position", "speed", "lateral")
"""Errors against the record that are summed."""


class DrivingStatistics(NamedTuple):
    """Sums over the vehicle-steps of each of S scenes, from which rates, divergences and errors follow."""

    steps: FloatArray
    """Number of vehicle-steps, shape (S,)."""
    vehicles: FloatArray
    """Number of vehicles, shape (S,)."""
    sums: dict[str, FloatArray]
    """Hard braking, collision, off-road, lane changes and speed by vehicle-step, `ever` by vehicle, shape (S,) each."""
    counts: dict[str, FloatArray]
    """Histogram of each quantity, shape (S, bins)."""
    squared: dict[str, FloatArray]
    """Squared errors of position [m^2], speed and lateral position after 5 s, and their number, shape (S,) each."""


def binned_quantities(behaviour: Behaviour) -> dict[str, tuple[Tensor, Tensor]]:
    """Return the values of each quantity in `BINS` with their scenes, shape (k,) each."""
    known = behaviour.known
    both = known[1:] & known[:-1]
    meets = known & (behaviour.ahead < MAX_RANGE)
    scene = behaviour.scene.expand_as(known)
    jerk = (behaviour.acceleration[1:] - behaviour.acceleration[:-1]) / DT
    inverse_ttc = -behaviour.rate / behaviour.ahead.clamp(min=LEAST_RANGE)
    return {
        "speed": (behaviour.speed[known], scene[known]),
        "acceleration": (behaviour.acceleration[known], scene[known]),
        "jerk": (jerk[both], scene[1:][both]),
        "yaw_rate": (behaviour.yaw_rate[known], scene[known]),
        "inverse_ttc": (inverse_ttc[meets], scene[meets]),
        "gap": (behaviour.ahead[known], scene[known]),
    }


def sum_by_scene(behaviour: Behaviour, scenes: int, errors: Errors | None = None) -> DrivingStatistics:
    """Return the statistics of some behaviour.

    Args:
        behaviour: Behaviour of vehicles.
        scenes: S, the number of scenes.
        errors: Errors after 5 s.
    """
    known = behaviour.known

    def by_scene(scene: Tensor, values: Tensor) -> FloatArray:
        return np.bincount(scene.numpy(), values.double().numpy(), minlength=scenes).astype(np.float64)

    def steps(values: Tensor) -> FloatArray:
        return by_scene(behaviour.scene, (values.double() * known).sum(dim=0))

    counts = {}
    for name, (values, scene) in binned_quantities(behaviour).items():
        low, high, bins = BINS[name]
        place = ((values.double() - low) / (high - low) * bins).floor().clamp(0, bins - 1).long()
        flat = np.bincount((scene * bins + place).numpy(), minlength=scenes * bins)
        counts[name] = flat.reshape(scenes, bins).astype(np.float64)
    squared = {}
    if errors is not None:
        # fields by name
        squared = {name: by_scene(errors.scene, getattr(errors, name).square()) for name in ERROR_NAMES}
        squared["number"] = by_scene(errors.scene, torch.ones_like(errors.position))
    return DrivingStatistics(
        steps=steps(known),
        vehicles=by_scene(behaviour.scene, known.any(dim=0)),
        sums={
            "hard_brake": steps(behaviour.acceleration <= HARD_BRAKE_ACCELERATION),
            "collision": steps(behaviour.contact),
            "off_road": steps(behaviour.off_road),
            "lane_changes": steps(behaviour.changed),
            "speed": steps(behaviour.speed),
            "ever": by_scene(behaviour.scene, (behaviour.contact & known).any(dim=0)),
        },
        counts=counts,
        squared=squared,
    )


def add_statistics(tallies: list[DrivingStatistics]) -> DrivingStatistics:
    """Return the sum of several statistics of the same scenes."""

    def add(name: str) -> dict[str, FloatArray]:
        parts = [getattr(one, name) for one in tallies]  # a field by its name
        return {key: np.sum([part[key] for part in parts], axis=0) for key in parts[0]}

    # likewise
    steps, vehicles = (np.sum([getattr(one, name) for one in tallies], axis=0) for name in ("steps", "vehicles"))
    return DrivingStatistics(steps, vehicles, add("sums"), add("counts"), add("squared"))
