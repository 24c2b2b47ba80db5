"""What does smoothing do to recorded accelerations, and how much traffic do the scenes hold?

    python -m benchmarks.driving.recorded_traffic DATA

DATA is the folder with the compact tables of US 101. Prints, over the vehicles that have somebody ahead, accelerations
and yaw rates by cut-off of the smoother, and the scenes to learn from and to test on.
"""

from pathlib import Path

import numpy as np
import typer

from training.data.scenes import load_us101_scenes, split_by_clock
from training.data.trajectories import DT

CUTOFFS = ((5.0, 5.0), (1.0, 1.0), (0.5, 0.5), (0.4, 0.35), (0.35, 0.25), (0.25, 0.2))
HARD_BRAKING = -3.0


def main(data: Path) -> None:
    """Print accelerations by cut-off, and the sizes of the scenes."""
    typer.echo("cut-off along/across [Hz]  std a [m/s^2]  share a <= -3  std jerk [m/s^3]  std yaw rate [rad/s]")
    for along, across in CUTOFFS:
        scenes = load_us101_scenes(data, along, across)
        chosen = [scene.acted & ~scene.leads_lane() for scene in scenes]
        jerks = [
            np.diff(scene.acceleration, axis=0)[mask[1:] & mask[:-1]] / DT
            for scene, mask in zip(scenes, chosen, strict=True)
        ]
        a = np.concatenate([scene.acceleration[mask] for scene, mask in zip(scenes, chosen, strict=True)])
        yaw_rate = np.concatenate([scene.yaw_rate[mask] for scene, mask in zip(scenes, chosen, strict=True)])
        share, jerk = (a <= HARD_BRAKING).mean(), np.concatenate(jerks).std()
        typer.echo(f"{along:g}/{across:g}  {a.std():.2f}  {share:.4f}  {jerk:.2f}  {yaw_rate.std():.3f}")
    for name, scenes in zip(("train", "test"), split_by_clock(load_us101_scenes(data)), strict=True):
        chosen = [scene.acted & ~scene.leads_lane() for scene in scenes]
        speed = np.concatenate([scene.speed[mask] for scene, mask in zip(scenes, chosen, strict=True)])
        steps = sum(int(scene.acted.sum()) for scene in scenes)
        typer.echo(
            f"{name}: {len(scenes)} scenes, {steps} vehicle-steps with an action, {len(speed)} of them with somebody "
            f"ahead, mean speed {speed.mean():.1f} m/s"
        )


if __name__ == "__main__":
    typer.run(main)
