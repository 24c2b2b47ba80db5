"""Command `export-ego`: a saved policy as an ONNX file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rare_envs.study.cli.options import AlgoOption, JsonOption, StatsOption, TrustOption
from rare_envs.study.cli.shell import keep_stdout_for_the_answer, print_json
from rare_envs.study.errors import BadInput, as_bad_input, output_file


def export_ego_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="A .zip saved by Stable-Baselines3.")],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="The .onnx file to write.")],
    algo: AlgoOption = None,
    stats: StatsOption = None,
    trust: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write a saved policy as ONNX, normalisation, memory and clipping included, and check that both act alike."""
    with keep_stdout_for_the_answer():
        done = export_ego(model, out, algo=algo, trust=trust, stats=stats)
    if as_json:
        print_json(done)
    else:
        print(
            f"Wrote {out}: its actions differ by {done['largest_difference']:.1e} at most "
            f"on {done['observations_tried']:,} random observations."
        )


def export_ego(
    model: Path, out: Path, algo: str | None = None, trust: bool = False, stats: str | None = None
) -> dict[str, Any]:
    """Write a Stable-Baselines3 `.zip` as ONNX and check that both act alike.

    Args:
        model: The `.zip`.
        out: The file to write, ending in `.onnx`.
        algo: Algorithm of the `.zip`, if the file does not tell.
        trust: As for `agents.load_ego`.
        stats: Likewise.

    Returns:
        What was written, JSON-ready.

    Raises:
        BadInput: The model cannot be read, the file cannot be written, or they act differently.
    """
    if model.suffix != ".zip":
        raise BadInput(
            f"Only policies saved by Stable-Baselines3, files that end in .zip, are exported; got {str(model)!r}."
        )
    if out.suffix != ".onnx":
        raise BadInput(f"Expected a file that ends in .onnx, got {str(out)!r}.")
    with output_file(out), as_bad_input(ValueError, OSError):
        from agents.onnx.export import ACTION_TOLERANCE, export_onnx
        from agents.sb3.saved_ego import load_saved_ego

        ego = load_saved_ego(model, algo, trust, stats)
        exported = export_onnx(ego, out)
    return {
        "model": str(model),
        "algorithm": ego.algorithm,
        "vec_normalize": None if ego.statistics_path is None else str(ego.statistics_path),
        "onnx": str(exported.path),
        "largest_difference": exported.difference,
        "tolerance": ACTION_TOLERANCE,
        "observations_tried": exported.observations,
    }
