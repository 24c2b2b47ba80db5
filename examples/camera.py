"""What the ego's camera sees: on the curved highway, at a cut-in, and in different weather.

    python examples/camera.py --out docs/images

Writes `camera.png` (four scenarios) and `weather.png` (one moment in four kinds of weather), pixels enlarged.
"""

from pathlib import Path
from typing import Annotated

import gymnasium as gym
import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image

import rare_envs  # noqa: F401  (registers the environments)

SCENES = {
    "rare_envs/Highway-v0": {},
    "rare_envs/CutIn-v0": {"cut_in_gap": 12.0, "lead_gap": 20.0},
    "rare_envs/CarFollowing-v0": {"gap": 15.0},
    "rare_envs/HardBrake-v0": {"gap": 22.0},
}
WEATHERS = (
    {"fog": 1e-4, "sun_elevation": 60.0, "sun_azimuth": 120.0, "sensor_noise": 0.0},
    {"fog": 1e-4, "sun_elevation": 8.0, "sun_azimuth": -70.0, "sensor_noise": 2.0},
    {"fog": 0.03, "sun_elevation": 30.0, "sun_azimuth": 0.0, "sensor_noise": 2.0},
    {"fog": 2e-4, "sun_elevation": 10.0, "sun_azimuth": 15.0, "sensor_noise": 10.0},
)
ENLARGED = 2
"""Each pixel is drawn as so many by so many."""


def view(env_id: str, seed: int, steps: int = 12, **options: float) -> NDArray[np.uint8]:
    """What the ego sees after some steps straight on."""
    env = gym.make(env_id, observation="camera", weather="fog" in options)
    picture, _ = env.reset(seed=seed, options=options)
    for _ in range(steps):
        picture, *_ = env.step(np.zeros(2, dtype=np.float32))
    return picture


def montage(pictures: list[NDArray[np.uint8]]) -> Image.Image:
    """Four pictures, two by two, with white between them."""
    edged = [
        np.pad(p.repeat(ENLARGED, 0).repeat(ENLARGED, 1), ((3, 3), (3, 3), (0, 0)), constant_values=255)
        for p in pictures
    ]
    return Image.fromarray(np.vstack((np.hstack(edged[:2]), np.hstack(edged[2:]))))


def main(
    out: Annotated[Path, typer.Option(help="Folder for the two pictures.")] = Path("."),
    seed: int = 5,
) -> None:
    """Take the pictures."""
    montage([view(env_id, seed, **options) for env_id, options in SCENES.items()]).save(out / "camera.png")
    highway = "rare_envs/Highway-v0"
    montage([view(highway, seed, **sky) for sky in WEATHERS]).save(out / "weather.png")


if __name__ == "__main__":
    typer.run(main)
