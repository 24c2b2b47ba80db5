"""Corrections of the ego `vision` in the scenarios in which it fails, by imitation of the rule that taught it.

    python -m training.egos.vision_corrections runs/vision/vision.safetensors --out runs/vision_corrected

In each round a search finds failures of the ego of that round. Half of them are held out. The ego drives the other
half, draws of the same scenarios and the situations of its first training; the expert that taught it
(`training.egos.expert_driver`), which knows the true state, labels the pictures, and the network learns from those of
all rounds (DAgger). At test time there is the network alone, which sees pictures and its own speed.

References:
    Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import nn

import rare_envs
import samplers
from agents import Provenance
from agents.vision import OBSERVATION, PilotNet, VisionEgo, load_vision, read_vision_provenance, save_vision
from rare_envs.files import replace_text
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.clock import Clock
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.egos.corrections import ROUNDS_FILE
from training.egos.image_dataset import LabelledPictures, collect, concatenate, drive_and_label, mirror
from training.egos.nominal_driving import judge_all_cases
from training.egos.vision import FILE, JUDGE_SEED

SEARCHED_BY_VISION = (("rare_envs/HardBrake-v0", "us101"),)
"""Scenarios and bases in which failures are searched."""
DRAWN_BY_VISION = (
    *SEARCHED_BY_VISION,
    ("rare_envs/CutIn-v0", "us101"),
    ("rare_envs/CutIn-v1", "us101"),
    ("rare_envs/CarFollowing-v0", "us101-gap"),
)
"""Scenarios and bases that are driven by draws."""
CAMERA_ROWS = 64
"""Scenarios that are driven at once."""
CORRECTED = ", corrected"
"""Behind the kind of an ego, once, however often it is corrected."""
FIRST_TICKS = 10
"""Ticks at the start that are all recorded: a short gap is braked for then or never, with half of the memory empty."""


@dataclass(frozen=True)
class VisionCorrectionConfig:
    """Settings of the corrections.

    Example:
        >>> VisionCorrectionConfig(rounds=0)
        Traceback (most recent call last):
        ...
        ValueError: Expected rounds of at least 1, got 0.
    """

    seed: int = 0
    rounds: int = 3
    simulations: int = 600
    """Of each search for failures."""
    driven: int = 192
    """Most failures of each search that are driven in training."""
    draws: int = 64
    """Draws of each scenario in a round."""
    drives: int = 14
    """Situations of the first training in a round, the network driving."""
    watched: int = 28
    """Such situations in the first round, the expert driving."""
    rows: int = 24
    """Scenarios of a situation."""
    seconds: float = 10.0
    """Length of a drive."""
    visits: int = 30_000
    """Pictures that are learned from in a round, with repetition."""
    batch: int = 32
    demanded_braking: float = 10.0
    """Hardest braking that the labels ask for [m/s^2]; the vehicle's is 5. An error of regression about a label of 5
    would brake less in half of the cases; about a label of 10 it brakes fully."""
    rate: float = 3e-4
    """Of Adam, falling to zero as a cosine in each round."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = {"seed": 0, "seconds": VisionEgo.dt}.get(name, 1)
            if name == "rate" and not 0.0 < value < math.inf:
                raise ValueError(f"Expected a positive rate, got {value}.")
            if name != "rate" and not least <= value < math.inf:
                raise ValueError(f"Expected {name} of at least {least}, got {value}.")

    @property
    def ticks(self) -> int:
        """Length of a drive in ticks."""
        return round(self.seconds / VisionEgo.dt)


def learn_pictures(
    network: PilotNet, data: LabelledPictures, config: VisionCorrectionConfig, rng: np.random.Generator
) -> float:
    """Train a network on labelled pictures, half of them mirrored; return its mean loss over the last 100 steps."""
    network.train().requires_grad_(True)
    optimiser = torch.optim.Adam(network.parameters(), config.rate)
    steps, losses = math.ceil(config.visits / config.batch), []
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * config.rate * (1.0 + math.cos(math.pi * step / steps))
        some = data.rows(torch.from_numpy(rng.integers(0, len(data.speed), config.batch)))
        some = mirror(some, torch.from_numpy(rng.random(config.batch) < 0.5))
        given = network(some.picture, some.earlier, some.speed)
        loss = nn.functional.smooth_l1_loss(given, some.expert, beta=0.5)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        optimiser.step()
        losses.append(loss.item())
    network.eval().requires_grad_(False)
    return float(np.mean(losses[-100:]))


def search_failures(
    network: PilotNet, env_id: str, base: str, simulations: int, seed: int
) -> tuple[samplers.Estimate, NDArray[np.float64]]:
    """Return an estimate of an ego's failure probability, and the failures (n, d) that it found."""
    problem = rare_envs.DrivingProblem(env_id, ego=VisionEgo(network), base=base)
    estimate = samplers.estimate(problem, samplers.TwoStage(), seed=seed, max_sim=simulations, ensemble_run=False)
    return estimate, np.asarray(estimate.failures.x)


def count_failing(network: PilotNet, env_id: str, x: NDArray[np.float64]) -> int:
    """Return in how many of some scenarios (n, d) an ego fails."""
    return int((rare_envs.DrivingProblem(env_id, ego=VisionEgo(network)).evaluate(x) <= 0.0).sum()) if len(x) else 0


@torch.inference_mode()
def drive_scenarios(
    network: PilotNet,
    env_id: str,
    x: NDArray[np.float64],
    recorded_share: float,
    config: VisionCorrectionConfig,
    rng: np.random.Generator,
) -> Iterator[LabelledPictures]:
    """Yield the expert's labels of what an ego sees in scenarios (n, d) until it collides."""
    if not len(x):  # a search may find no failure
        return
    world = World(find_scenario(env_id), Sensing(OBSERVATION), clock=Clock(horizon=config.seconds))
    for rows in torch.split(torch.from_numpy(x).float(), CAMERA_ROWS):
        yield from drive_and_label(
            world,
            world.start(rows),
            network,
            1.0,
            config.ticks,
            recorded_share,
            0.0,
            rng,
            brakes=config.demanded_braking,
            first_ticks=FIRST_TICKS,
        )


def correct_vision(
    before: PilotNet, config: VisionCorrectionConfig, report: Callable[[str], None] = lambda _: None
) -> tuple[PilotNet, list[dict[str, Any]]]:
    """Correct an ego that sees.

    Args:
        before: Its network; it stays as it is.
        config: Settings.
        report: Takes a line of progress.

    Returns:
        The corrected network, and for each round and scenario searched: p of the ego at its beginning, with interval,
        failures found, driven in training and held out, and how many of each the corrected ego fails.
    """
    rng, network = np.random.default_rng(config.seed), copy.deepcopy(before)
    data = list(_watch_expert(config, rng))
    held, records = [], list[dict[str, Any]]()
    for number in range(config.rounds):
        for k, (env_id, base) in enumerate(SEARCHED_BY_VISION):
            seed = 1000 * config.seed + 10 * number + k
            estimate, x = search_failures(network, env_id, base, config.simulations, seed)
            x = rng.permutation(x)
            driven, kept = x[::2][: config.driven], x[1::2][: config.driven]
            held.append((env_id, driven, kept))
            low, high = estimate.interval
            records.append({"round": number, "env_id": env_id, "base": base, "p": estimate.p, "low": low, "high": high})
            records[-1] |= {"found": len(x), "driven": len(driven), "held_out": len(kept)}
            report(f"round {number}: {env_id} p = {estimate.p:.2g}, {len(x)} failures found")
            data += drive_scenarios(network, env_id, driven, 0.3, config, rng)
        data += _record_round(network, config, rng)
        pictures = concatenate(data)
        loss = learn_pictures(network, pictures, config, rng)
        report(f"round {number}: {len(pictures.speed):,} pictures, loss {loss:.4f}")
    for record, (env_id, driven, kept) in zip(records, held, strict=True):
        record["driven_failing"], record["held_out_failing"] = (
            count_failing(network, env_id, x) for x in (driven, kept)
        )
    return network, records


def _watch_expert(config: VisionCorrectionConfig, rng: np.random.Generator) -> Iterator[LabelledPictures]:
    """Yield pictures of the expert's own drives, with noise, which are cheap: only those recorded are taken."""
    return collect(
        None,
        0.0,
        drives=config.watched,
        rows=config.rows,
        ticks=config.ticks,
        recorded_share=0.06,
        noise=1.0,
        rng=rng,
        brakes=config.demanded_braking,
    )


def _record_round(
    network: PilotNet, config: VisionCorrectionConfig, rng: np.random.Generator
) -> Iterator[LabelledPictures]:
    """Yield what the ego meets in the situations of its first training and in draws of the scenarios."""
    yield from collect(
        network,
        1.0,
        drives=config.drives,
        rows=config.rows,
        ticks=config.ticks,
        recorded_share=0.15,
        noise=0.0,
        rng=rng,
        brakes=config.demanded_braking,
    )
    for env_id, base in DRAWN_BY_VISION:
        x = np.asarray(load_base(find_scenario(env_id), base).sample(config.draws, rng))
        yield from drive_scenarios(network, env_id, x, 0.15, config, rng)


@use_one_thread()
def main(
    ego: Annotated[Path, typer.Argument(help="File of the ego, as training.egos.vision writes it.")],
    out: Annotated[Path, typer.Option(help="Folder for the corrected ego.")],
    seed: Annotated[int, typer.Option(help="Of everything that is random.")] = VisionCorrectionConfig.seed,
    rounds: Annotated[int, typer.Option(help="Of corrections.")] = VisionCorrectionConfig.rounds,
    judged: Annotated[int, typer.Option(help="Minutes of driving in each kind of ordinary traffic to judge it.")] = 0,
) -> None:
    """Correct the ego `vision`, and write it to OUT/vision.safetensors, with the counts in OUT/rounds.json."""
    with report_errors("vision_corrections"):
        config = VisionCorrectionConfig(seed=seed, rounds=rounds)
        before, origin = load_vision(ego).network, read_vision_provenance(ego)
        out.mkdir(parents=True, exist_ok=True)
    network, records = correct_vision(before, config, lambda line: typer.echo(line, err=True))
    replace_text(out / ROUNDS_FILE, json.dumps(records, indent=1) + "\n")
    metrics = judge_all_cases(VisionEgo(network), judged, JUDGE_SEED) if judged else {}
    command = f"python -m training.egos.vision_corrections FILE --out OUT --seed {seed} --rounds {rounds}"
    command += f" --judged {judged}" if judged else ""
    provenance = Provenance(
        kind=origin.kind.removesuffix(CORRECTED) + CORRECTED,
        command=f"{origin.command}, then {command}",
        data=origin.data,
        data_licence=origin.data_licence,
        metrics=metrics,
    )
    print(f"Wrote {save_vision(network, provenance, out / FILE)}.")


if __name__ == "__main__":
    run_command(main)
