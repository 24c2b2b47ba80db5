"""Braking of an ego beside that of the rule that taught `vision`, tick by tick, when a lead close ahead brakes hard.

    python -m training.egos.braking_lag --ego vision

The brakings are those of `HardBrake-v0` with gaps of 2 to 3.2 m at 6 to 9 m/s and a lead that brakes by 6 to 7.5 m/s^2,
as far as the rule avoids a collision: it brakes fully from the first moment on, and there is no time for less.
"""

from __future__ import annotations

from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from agents import load_ego
from agents.vision import ACCELERATION_UNIT
from rare_envs import DrivingProblem
from rare_envs.egos.needs import resolve
from rare_envs.egos.policy import as_driver
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.rollout import drive
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.egos.expert_driver import VISION_EXPERT, expert_outputs

SCENARIO = "rare_envs/HardBrake-v0"
SHORT_BRAKINGS = ((6.0, 9.0), (2.0, 3.2), (6.0, 7.5))
"""Ranges of speed [m/s], gap [m] and the lead's deceleration [m/s^2]."""
DECISIVE_SECONDS = 2.5
"""Time [s] in which these brakings are decided: everybody stands by then."""


class BrakingLag(NamedTuple):
    """What an ego and its teacher do at each of T ticks, over the egos that have not collided."""

    driving: NDArray[np.int64]
    """Egos that have not collided, shape (T,)."""
    ego: NDArray[np.float64]
    """Mean acceleration of the ego [m/s^2], NaN without any, shape (T,)."""
    teacher: NDArray[np.float64]
    """Mean acceleration of the teacher in the same states [m/s^2], NaN without any, shape (T,)."""
    collided: int
    """Egos that have collided at the end."""


def draw_short_brakings(n: int, seed: int) -> NDArray[np.float64]:
    """Draw n brakings at short gaps, and return those in which the teacher avoids a collision, shape (at most n, 3).

    Example:
        >>> draw_short_brakings(4, seed=0).shape[1]
        3
    """
    low, high = np.array(SHORT_BRAKINGS).T
    x = np.random.default_rng(seed).uniform(low, high, (n, len(low)))
    return np.asarray(x[DrivingProblem(SCENARIO, ego=VISION_EXPERT, horizon=DECISIVE_SECONDS).evaluate(x) > 0.0])


@torch.inference_mode()
def compare_braking(ego: Any, x: NDArray[np.float64], seconds: float = DECISIVE_SECONDS) -> BrakingLag:
    """Drive an ego in brakings of the lead, and compare what it does with what its teacher would do there.

    Args:
        ego: An ego as `rare_envs.DrivingProblem` takes it, without noise of its own.
        x: Speed, gap and deceleration of `HardBrake-v0`, shape (n, 3).
        seconds: Length of the drive [s].

    Example:
        >>> lag = compare_braking("idm", np.array([[8.0, 2.5, 6.0]]), seconds=0.3)
        >>> lag.ego.round(1).tolist(), lag.teacher.round(1).tolist()
        ([-5.0, -5.0, -5.0], [-5.0, -5.0, -5.0])
    """
    needs = resolve(ego)
    world = World(find_scenario(SCENARIO), Sensing(needs.observation), clock=Clock(horizon=seconds))
    if needs.lidar:
        world = world.with_lidar()
    driving, own, taught = [], [], []
    before = None
    for episode in drive(world, as_driver(ego, world, needs), torch.from_numpy(x).float()):
        if before is not None:
            on = ~before.collided
            driving.append(int(on.sum()))
            own.append(float(((episode.state.speed - before.state.speed)[on, 0] / world.clock.dt).mean()))
            taught.append(float(ACCELERATION_UNIT * expert_outputs(before)[on, 0].mean()))
        before = episode
    assert before is not None
    return BrakingLag(np.array(driving), np.array(own), np.array(taught), int(before.collided.sum()))


@use_one_thread()
def main(
    ego: Annotated[str, typer.Option(help="As in every command: idm, vision, a file ...")] = "vision",
    brakings: Annotated[int, typer.Option(min=1, help="Brakings that are drawn.")] = 64,
    seed: Annotated[int, typer.Option()] = 5,
) -> None:
    """Compare the braking of an ego with its teacher's."""
    with report_errors("braking_lag"):
        x = draw_short_brakings(brakings, seed)
        lag = compare_braking(load_ego(ego), x)
    print(f"{lag.collided} of {len(x)} collide; the teacher: none")
    print("| time, s | driving | ego, m/s^2 | teacher, m/s^2 |")
    print("|---|---|---|---|")
    for tick, (number, own, taught) in enumerate(zip(lag.driving, lag.ego, lag.teacher, strict=True)):
        print(f"| {0.1 * tick:.1f} | {number} | {own:.2f} | {taught:.2f} |")


if __name__ == "__main__":
    run_command(main)
