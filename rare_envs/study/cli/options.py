"""Words that several commands of the command line take, with what their help says of them."""

from __future__ import annotations

from enum import Enum
from typing import Annotated

import typer


class Noise(str, Enum):
    """Words for the `noise` argument of `DrivingProblem`: True, "fixed" and False."""

    ON = "on"
    FIXED = "fixed"
    OFF = "off"

    @property
    def argument(self) -> bool | str:
        """What `DrivingProblem` takes for the word."""
        return {"on": True, "off": False}.get(self.value, self.value)


Env = Annotated[str, typer.Argument(metavar="ENV", help="Environment, such as rare_envs/CutIn-v0.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object and nothing else.")]
Trust = Annotated[
    bool, typer.Option("--trust", help="Let the ego's .zip run code; open it though others can write to it.")
]
Seed = Annotated[int, typer.Option(help="Seed; the same seed gives the same answer.")]
Base = Annotated[str | None, typer.Option(help="Base distribution: a name or a JSON file.")]
Drivers = Annotated[str | None, typer.Option(help="Of the vehicles around the ego: mgail, gail, bc, idm or a file.")]
NoiseOption = Annotated[Noise, typer.Option("--noise", help="The drivers' noise: part of x, one fixed sequence, none.")]
Observation = Annotated[
    str, typer.Option(help="What the ego observes: features, lidar, kinematics, camera, or camera+lidar.")
]
Shown = Annotated[
    str | None,
    typer.Option(
        "--observation",
        help="What the ego observes: features, lidar, kinematics, camera, speed, or camera+lidar; by default what it "
        "asks for, else features.",
    ),
]
Weather = Annotated[bool, typer.Option("--weather", help="Make weather and the camera's noise parameters.")]
Action = Annotated[str, typer.Option(help="What it decides: continuous, each tick, or HighwayEnv's meta, each second.")]
Horizon = Annotated[float | None, typer.Option(help="Length of an episode in seconds.")]
Algo = Annotated[str | None, typer.Option(help="Algorithm of the .zip, if the file does not tell.")]
Method = Annotated[str, typer.Option(help="Estimation method; see rare-envs list.")]
Measure = Annotated[
    str, typer.Option(help="Safety measure f, small is dangerous: a name, module:function or stl:FORMULA.")
]
Collisions = Annotated[str, typer.Option(help="Which count: ego, or any, between others too.")]
Gamma = Annotated[float, typer.Option(help="Threshold: P[f <= gamma]; 0 counts collisions.")]
Ego = Annotated[str, typer.Argument(metavar="EGO", help="An ego, as for estimate --ego.")]
