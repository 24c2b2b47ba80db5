"""Examples of each command, for its help page."""

from __future__ import annotations

import typer

EXAMPLES: dict[str, tuple[str, ...]] = {
    "": ("rare-envs list", "rare-envs estimate rare_envs/CutIn-v0 --ego idm --max-sim 3000"),
    "list": ("rare-envs list", "rare-envs list egos", "rare-envs list CutIn-v0"),
    "estimate": (
        "rare-envs estimate rare_envs/CutIn-v0 --ego ppo.zip --out runs/cutin",
        "rare-envs estimate rare_envs/CarFollowing-v0 --base us101-gap --method mc --max-sim 1e5",
        "rare-envs estimate highway-fast-v0 --ego dqn.zip --max-sim 300",
    ),
    "resume": ("rare-envs resume runs/cutin", "rare-envs resume runs/cutin --workers 4"),
    "risk": ("rare-envs risk ppo.zip --out runs/risk", "rare-envs risk idm --sites us101,i80"),
    "bases": ("rare-envs bases cut_in", "rare-envs bases rare_envs/HardBrake-v0 --json"),
    "compare": ("rare-envs compare old.zip new.zip rare_envs/CutIn-v0 --out runs/compared",),
    "plan": ("rare-envs plan rare_envs/CutIn-v0 --ego ppo.zip --cov 0.1", "rare-envs plan runs/cutin --cov 0.05"),
    "replay": (
        "rare-envs replay runs/cutin --out crash.gif",
        "rare-envs replay runs/cutin --failure 3 --ego new.zip",
        "rare-envs replay runs/cutin --all",
    ),
    "report": ("rare-envs report runs/cutin --figures pdf",),
    "export": (
        "rare-envs export runs/cutin --out crash.xosc",
        "rare-envs export runs/cutin --out crash.xml --format commonroad",
    ),
    "fit": (
        "rare-envs fit --highd path/to/highD/data --out bases --name cologne",
        "rare-envs fit --tgsim path/to/tgsim --cut-gaps --scenario cut_in --out bases",
    ),
    "train-ego": (
        "rare-envs train-ego rare_envs/CutIn-v0 --steps 200000 --out ppo.zip",
        "rare-envs train-ego rare_envs/CutIn-v0 --algo dqn --out dqn.zip",
    ),
    "train-drivers": ("rare-envs train-drivers --highd path/to/highD/data --out runs/drivers --method gail",),
    "check-ego": (
        "rare-envs check-ego ppo.zip rare_envs/CutIn-v0",
        "rare-envs check-ego tcp://127.0.0.1:5555 rare_envs/CutIn-v0",
    ),
    "serve-ego": ("rare-envs serve-ego ppo.zip --bind tcp://127.0.0.1:5555",),
    "export-ego": ("rare-envs export-ego ppo.zip ppo.onnx",),
    "corpus": (
        "rare-envs corpus add runs/cutin",
        "rare-envs corpus run --ego new.zip --junit corpus.xml",
    ),
    "corpus add": ("rare-envs corpus add runs/cutin --corpus corpus --most 5",),
    "corpus run": ("rare-envs corpus run --ego new.zip --corpus corpus --junit corpus.xml",),
}
"""Commands to examples of them, in one line each."""


def format_examples(command: str) -> str:
    """Return the text below a help page, whose lines are not to be filled; empty where there are no examples."""
    lines = EXAMPLES.get(command, ())
    return "\n".join(("\b", "Examples:", *(f"  {line}" for line in lines))) if lines else ""


def add_examples(app: typer.Typer, prefix: str = "") -> None:
    """Put its examples below the help page of each command of an app, those of its groups included.

    Args:
        app: All its commands have a name.
        prefix: Name of the group that the app is, with a space behind it.
    """
    for command in app.registered_commands:
        command.epilog = format_examples(f"{prefix}{command.name}")
    for group in app.registered_groups:
        assert group.typer_instance is not None
        group.epilog = format_examples(f"{prefix}{group.name}")
        add_examples(group.typer_instance, f"{prefix}{group.name} ")
