"""MGAIL's gradient through a learned forward model against that through the simulator.

    python -m benchmarks.driving.forward_model DATA RUN

DATA is the folder with the tables of US 101, RUN that of a training by MGAIL. A model learns from rollouts of the
trained driver; then both ways give the gradient of the critic's cost with respect to all weights of the driver, in the
same scenes with the same noise. Their cosine stands beside that of two noises through the simulator, and beside that of
a gradient which forgets that actions change what is seen.
"""

import copy
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import torch
import typer
from torch import Tensor

from agents import read_driver
from rare_envs.threads import use_one_thread
from training.imitation.algorithms.critic import Critic, critic_inputs, policy_cost
from training.imitation.algorithms.learner import Learner
from training.imitation.algorithms.rollout import roll_out
from training.imitation.datasets import Source, load_scenes
from training.imitation.fit import CHECKPOINT, prepare_data
from training.imitation.run_folder import DRIVER, read_training_settings
from training.imitation.traffic.scene_pool import draw_pool

HORIZONS = (5, 15, 30)
"""Ticks."""
GRADIENT_COLUMNS = ("learned", "other noise", "no state", "length, learned / simulator")


def train_forward_model(data: Path, run: Path, rounds: int) -> Learner:
    """Return the learner of a finished training, and a forward model that has learned from its rollouts."""
    _, config = read_training_settings(run)
    prepared = prepare_data(load_scenes(Source("data", data))[0])
    policy = copy.deepcopy(read_driver(run / DRIVER).policy).requires_grad_(True)
    critic = Critic()
    critic.load_state_dict(torch.load(run / CHECKPOINT, weights_only=True)["critic"])
    config = replace(config, learned_model=True, horizon=(HORIZONS[-1],) * 2, updates=rounds)
    scenes, generator = torch.unique(prepared.pairs.scene), torch.Generator().manual_seed(0)
    learner = Learner(config, prepared.recording, scenes, prepared.pairs, policy, critic, generator)
    for learner.update in range(rounds):
        with torch.no_grad():
            steps = learner.drive(1.0)
        learner.learn_model(steps)
    return learner


def gradient(learner: Learner, horizon: int, start: int, noise: int, learned: bool, credit: float) -> Tensor:
    """Return the gradient of the critic's cost with respect to all weights, flat."""
    config = learner.config
    chance = torch.Generator().manual_seed(start)
    pool = draw_pool(learner.recording, learner.among, config.scenes, 60, horizon, config.colour, chance)
    chance = torch.Generator().manual_seed(1000 + noise)
    model = learner.model if learned else None
    steps, _ = roll_out(learner.recording, learner.policy, pool, horizon, config.colour, credit, chance, model)
    cost = policy_cost(learner.critic, critic_inputs(learner.policy, steps.features, steps.action)).mean()
    return torch.cat([part.flatten() for part in torch.autograd.grad(cost, list(learner.policy.parameters()))])


def compare_gradients(learner: Learner, horizon: int, starts: int) -> list[float]:
    """Return means of `GRADIENT_COLUMNS` over some starts."""
    rows = []
    for start in range(starts):
        credit = learner.config.credit
        exact = gradient(learner, horizon, start, 0, False, credit)
        learned = gradient(learner, horizon, start, 0, True, credit)
        others = (
            learned,
            gradient(learner, horizon, start, 1, False, credit),
            gradient(learner, horizon, start, 0, False, 0.0),
        )
        cosines = [float(torch.cosine_similarity(exact, other, dim=0)) for other in others]
        rows.append([*cosines, float(learned.norm() / exact.norm())])
    return torch.tensor(rows).mean(dim=0).tolist()


@use_one_thread()
def main(
    data: Annotated[Path, typer.Argument(help="Folder with the compact tables of US 101.")],
    run: Annotated[Path, typer.Argument(help="Folder of a training by MGAIL.")],
    rounds: Annotated[int, typer.Option(help="Rollouts that the model learns from.")] = 150,
    starts: Annotated[int, typer.Option(help="Sets of scenes.")] = 8,
) -> None:
    """Compare the two gradients."""
    learner = train_forward_model(data, run, rounds)
    print(f"| ticks | {' | '.join(GRADIENT_COLUMNS)} |\n|{'---|' * (len(GRADIENT_COLUMNS) + 1)}")
    for horizon in HORIZONS:
        print(
            f"| {horizon} | {' | '.join(f'{value:.2f}' for value in compare_gradients(learner, horizon, starts))} |",
            flush=True,
        )


if __name__ == "__main__":
    typer.run(main)
