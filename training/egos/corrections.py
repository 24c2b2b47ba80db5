"""Corrections of a learned ego in the scenarios in which it fails, by imitation of an expert that sees the true state.

    python -m training.egos.corrections runs/imitation/driver.safetensors --data TABLES --out runs/corrected

In each round the ego drives ordinary traffic, draws of the scenarios, and failures that a search has found for the ego
of that round. What it perceives on its way is labelled, and the network learns from all rounds (DAgger). The label in
ordinary traffic, and where recorded people were, is what the ego did before any correction, so that it forgets nothing;
in the scenarios an expert may brake harder than that. Half of the failures are held out: they tell whether the ego
learned to avoid crashes or those scenarios. At test time there is the network alone, which sees what its lidar shows.

References:
    Ross, Gordon and Bagnell, "A reduction of imitation learning and structured prediction to no-regret online
    learning", AISTATS 2011.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor, nn

import rare_envs
import samplers
from agents import LearnedDriver, LearnedEgo, Provenance, read_driver, read_provenance, save_driver
from agents.learned.networks import Policy
from rare_envs.files import replace_text
from rare_envs.scenarios.base_distributions import load_base
from rare_envs.scenarios.registry import find_scenario
from rare_envs.simulation.sensing import Sensing
from rare_envs.simulation.world import World
from rare_envs.threads import use_one_thread
from training.command_line import report_errors, run_command
from training.egos.correction_labels import Labelled, record_drive
from training.egos.imitation import JUDGED, JUDGED_SEED
from training.egos.nominal_driving import draw_inputs, judge_all_cases, make_world
from training.egos.nominal_traffic import CASES
from training.imitation.clone import collect_pairs
from training.imitation.evaluate import header_metrics
from training.imitation.traffic import stack_scenes
from training.imitation.train import DRIVER, Source, load_scenes

OUTPUT_WEIGHTS = (1.0, 3.0, 0.3, 0.3)
"""Weights of the outputs in the loss: acceleration, yaw rate and the logarithms of their standard deviations."""
SEARCHED = (("rare_envs/CutIn-v0", "us101"), ("rare_envs/CutIn-v1", "us101"))
"""Scenarios and bases in which failures are searched."""
DRAWN = (
    *SEARCHED,
    ("rare_envs/CutIn-v0", "us101-15-offsets"),
    ("rare_envs/CutIn-v0", "highway"),
    ("rare_envs/HardBrake-v0", "us101"),
    ("rare_envs/CarFollowing-v0", "us101-gap"),
    ("rare_envs/CarFollowing-v0", "highway"),
)
"""Scenarios and bases that are driven by draws."""
ROUNDS_FILE = "rounds.json"


@dataclass(frozen=True)
class CorrectionConfig:
    """Settings of the corrections.

    Example:
        >>> CorrectionConfig(rounds=0)
        Traceback (most recent call last):
        ...
        ValueError: Expected rounds of at least 1, got 0.
    """

    seed: int = 0
    rounds: int = 1
    draws: int = 1000
    """Draws of each scenario in a round."""
    recorded: int = 100_000
    """Moments of recorded people, at which the ego is to do what it did."""
    ordinary: int = 100
    """Drives of a minute in each case of ordinary traffic in a round."""
    simulations: int = 2000
    """Of each search for failures."""
    steps: int = 3000
    """Gradient steps of a round."""
    batch: int = 1024
    rate: float = 5e-4
    """Of Adam, falling to zero as a cosine in each round."""

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            least = 0 if name == "seed" else 1
            if name != "rate" and value < least:
                raise ValueError(f"Expected {name} of at least {least}, got {value}.")


def learn_labels(policy: Policy, data: Labelled, config: CorrectionConfig, rng: np.random.Generator) -> float:
    """Train a network on labels, and return its mean loss over the last hundred steps."""
    policy.requires_grad_(True)
    features, outputs = (part.clone() for part in data)  # they were recorded in inference mode
    weights = outputs.new_tensor(OUTPUT_WEIGHTS)
    optimiser = torch.optim.Adam(policy.parameters(), config.rate)
    losses = []
    for step in range(config.steps):
        for group in optimiser.param_groups:
            group["lr"] = 0.5 * config.rate * (1.0 + math.cos(math.pi * step / config.steps))
        some = torch.from_numpy(rng.integers(0, len(features), config.batch))
        given = torch.cat(policy(features[some]), dim=1)
        errors = nn.functional.smooth_l1_loss(given, outputs[some], reduction="none", beta=0.3)
        loss = (weights * errors).mean()
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        losses.append(loss.item())
    policy.requires_grad_(False)
    return float(np.mean(losses[-100:]))


def find_failures(
    driver: LearnedDriver, env_id: str, base: str, simulations: int, seed: int
) -> tuple[samplers.Estimate, NDArray[np.float64]]:
    """Return an estimate of an ego's failure probability, and the failures (n, d) that it found."""
    problem = rare_envs.DrivingProblem(env_id, ego=LearnedEgo(driver), base=base)
    estimate = samplers.estimate(problem, samplers.TwoStage(), seed=seed, max_sim=simulations)
    return estimate, np.asarray(estimate.failures.x)


def failing_share(driver: LearnedDriver, env_id: str, x: NDArray[np.float64]) -> float:
    """Return the share of scenarios (n, d) in which an ego fails; NaN of none."""
    if not len(x):
        return math.nan
    return float((rare_envs.DrivingProblem(env_id, ego=LearnedEgo(driver)).evaluate(x) <= 0.0).mean())


def correct_ego(
    before: LearnedDriver,
    config: CorrectionConfig,
    recorded: Tensor | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> tuple[LearnedDriver, list[dict[str, Any]]]:
    """Correct an ego.

    Args:
        before: The ego; it stays as it is.
        config: Settings.
        recorded: What recorded people perceived, of which the ego is to make what it did, shape (n, 51).
        report: Takes a line of progress.

    Returns:
        The corrected ego, and for each round and scenario searched: p of the ego at its beginning, with interval,
        failures found, driven in training and held out, and the share of each in which the corrected ego fails.
    """
    rng = np.random.default_rng(config.seed)
    driver = replace(before, policy=copy.deepcopy(before.policy))
    data: list[Labelled] = [] if recorded is None else [_keep_recorded(before.policy, recorded, config, rng)]
    held, records = [], list[dict[str, Any]]()
    for number in range(config.rounds):
        for k, (env_id, base) in enumerate(SEARCHED):
            seed = 1000 * config.seed + 10 * number + k
            estimate, x = find_failures(driver, env_id, base, config.simulations, seed)
            x = rng.permutation(x)
            driven, kept = x[::2], x[1::2]
            held.append((env_id, driven, kept))
            low, high = estimate.interval
            records.append({"round": number, "env_id": env_id, "base": base, "p": estimate.p, "low": low, "high": high})
            records[-1] |= {"found": len(x), "driven": len(driven), "held_out": len(kept)}
            report(f"round {number}: {env_id} p = {estimate.p:.2g}, {len(x)} failures found")
            if len(driven):
                world = World(find_scenario(env_id), Sensing("features", lidar=True))
                data.append(record_drive(driver, before.policy, world, driven, 2, corrected=True))
        data += _record_round(driver, before.policy, config, rng)
        everything = Labelled(*(torch.cat(parts) for parts in zip(*data, strict=True)))
        loss = learn_labels(driver.policy, everything, config, rng)
        report(f"round {number}: {len(everything.features):,} moments, loss {loss:.4f}")
    for record, (env_id, driven, kept) in zip(records, held, strict=True):
        record["driven_failing"], record["held_out_failing"] = (
            failing_share(driver, env_id, x) for x in (driven, kept)
        )
    return driver, records


@torch.inference_mode()
def _keep_recorded(teacher: Policy, features: Tensor, config: CorrectionConfig, rng: np.random.Generator) -> Labelled:
    """Return some moments of recorded people with what the ego does there before all corrections."""
    some = features[torch.from_numpy(rng.integers(0, len(features), config.recorded))]
    return Labelled(some, torch.cat(teacher(some), dim=1))


def _record_round(
    driver: LearnedDriver, teacher: Policy, config: CorrectionConfig, rng: np.random.Generator
) -> Iterator[Labelled]:
    """Yield what the ego meets in ordinary traffic and in draws of the scenarios."""
    for case in CASES.values():
        world = make_world(case)
        x = draw_inputs(case, world, config.ordinary, 0, rng)
        yield record_drive(driver, teacher, world, x, 10, corrected=False)
    for env_id, base in DRAWN:
        scenario = find_scenario(env_id)
        x = np.asarray(load_base(scenario, base).sample(config.draws, rng))
        world = World(scenario, Sensing("features", lidar=True))
        yield record_drive(driver, teacher, world, x, 3, corrected=True)


@use_one_thread()
def main(
    driver: Annotated[Path, typer.Argument(help="File of the ego, as training.egos.imitation writes it.")],
    out: Annotated[Path, typer.Option(help="Folder for the corrected ego.")],
    data: Annotated[Path, typer.Option(help="Folder with the compact tables of US 101, to measure it in.")],
    seed: Annotated[int, typer.Option(help="The same seed gives the same weights.")] = CorrectionConfig.seed,
    rounds: Annotated[int, typer.Option(help="Of corrections.")] = CorrectionConfig.rounds,
) -> None:
    """Correct the ego `imitation`, and write it to OUT/driver.safetensors, with the counts in OUT/rounds.json."""
    with report_errors("corrections"):
        config = CorrectionConfig(seed=seed, rounds=rounds)
        before, origin = read_driver(driver), read_provenance(driver)
        learn, test = load_scenes(Source("data", data))
        out.mkdir(parents=True, exist_ok=True)
    recorded = collect_pairs(stack_scenes(learn)).features
    corrected, records = correct_ego(before, config, recorded, lambda line: typer.echo(line, err=True))
    replace_text(out / ROUNDS_FILE, json.dumps(records, indent=1) + "\n")
    metrics = header_metrics(stack_scenes(test), corrected)
    ordinary = judge_all_cases(LearnedEgo(corrected), JUDGED, JUDGED_SEED)
    command = f"python -m training.egos.corrections DRIVER --data {data.name} --out OUT --seed {seed} --rounds {rounds}"
    provenance = Provenance(
        kind=f"{origin.kind}, corrected",
        command=f"{origin.command}, then {command}",
        data=origin.data,
        data_licence=origin.data_licence,
        metrics={**metrics, "ordinary": ordinary},
    )
    print(f"Wrote {save_driver(corrected, provenance, out / DRIVER)}.")


if __name__ == "__main__":
    run_command(main)
