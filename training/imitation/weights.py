"""An ensemble of drivers around a trained one, and the distribution of their last layers, by graphical lasso.

    python -m training.imitation.weights runs/mgail --members 32 --out mgail.safetensors

A member continues the training of the base, trunk frozen, on scenes drawn from the base's with repetition, so that
members differ by chance alone. The spread says how far the last layer can move without loss; it is no posterior.
Correlations are shrunk towards 0, the graphical lasso keeps the dependences that stand out, and the penalty is the one
with the greatest likelihood of held-out members.

References:
    Friedman, Hastie and Tibshirani, "Sparse inverse covariance estimation with the graphical lasso", Biostatistics
    9, 2008.
    O'Kelly, Sinha, Namkoong, Duchi and Tedrake, "Scalable end-to-end autonomous vehicle testing via rare-event
    simulation", NeurIPS 2018, section 4.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import track
from sklearn.covariance import graphical_lasso
from sklearn.exceptions import ConvergenceWarning

from agents import LearnedDriver, read_driver, read_provenance, save_driver
from agents.learned.networks import RADIUS, WEIGHT_NAMES, WeightDistribution, head_weights
from rare_envs.files import open_ordinary, replace_file
from rare_envs.startup import use_one_thread
from samplers.problem import FloatArray
from training.command_line import report_errors, run_command
from training.imitation.config import Config
from training.imitation.learner import Learner, make_critic, run_updates
from training.imitation.traffic import Pairs
from training.imitation.train import (
    CHECKPOINT,
    DRIVER,
    Data,
    load_scenes,
    prepare_data,
    read_training_settings,
)

PENALTIES = (0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.25, 0.2, 0.15, 0.1)
"""Penalties on correlations, in the order they are tried; with `SHRINKAGE` the first keeps no dependence."""
SHRINKAGE = 0.25
"""Share of the identity that is mixed into the correlations."""
FOLDS = 5
"""Number of parts that members are held out in."""
DUALITY_GAP = 0.05
"""Duality gap [nats] at which the lasso has converged: far less than the likelihoods of two penalties differ by."""
INNER_TOLERANCES = (1e-6, 1e-4)
"""Tolerances of the lasso's inner problems: the first needs fewer rounds, the second succeeds where the first fails."""


@dataclass(frozen=True)
class Ensemble:
    """Settings of an ensemble: enough members to fit a distribution."""

    members: int = 32
    updates: int = 60
    """Number of updates of each member."""
    seed: int = 0

    def __post_init__(self) -> None:
        if self.members < 2 * FOLDS:
            raise ValueError(f"Expected {2 * FOLDS} or more members to fit a distribution, got {self.members}.")
        if self.updates < 2:
            raise ValueError(f"Expected 2 or more updates of each member, got {self.updates}.")


class Member(NamedTuple):
    """Weights of the last layer of a member (404,), and their standard deviations over the second half of its run."""

    weights: FloatArray
    within: FloatArray


def train_member(
    data: Data, driver: LearnedDriver, base: Config, checkpoint: Path, ensemble: Ensemble, number: int
) -> Member:
    """Train a member around a base: a driver, its settings and its checkpoint; the number decides all chance."""
    (seed,) = np.random.SeedSequence([ensemble.seed, number]).generate_state(1)
    generator = torch.Generator().manual_seed(int(seed))
    scenes = torch.unique(data.pairs.scene)
    drawn = scenes[torch.randint(len(scenes), (len(scenes),), generator=generator)]
    rows = torch.cat([(data.pairs.scene == scene).nonzero().flatten() for scene in drawn])
    policy = copy.deepcopy(driver.policy)
    policy.head.requires_grad_(True)
    names = ("horizon", "age", "clone_weight")
    ends: dict[str, Any] = {name: (getattr(base, name)[1],) * 2 for name in names}  # of schedules, fields by name
    config = replace(base, updates=ensemble.updates, warm_up=0, **ends)
    pairs = Pairs(*(column[rows] for column in data.pairs))
    learner = Learner(config, data.recording, drawn, pairs, policy, make_critic(), generator)
    learner.inherit(checkpoint)
    visited = [head_weights(policy).detach() for _ in run_updates(learner)]
    late = torch.stack(visited[len(visited) // 2 :]).double().numpy()
    return Member(late[-1], late.std(axis=0))


def train_members(folder: Path, ensemble: Ensemble, progress: bool = False) -> list[Member]:
    """Train an ensemble around the driver in a folder; members that are kept there are not trained again."""
    source, base = read_training_settings(folder)
    driver = read_driver(folder / DRIVER)
    own = head_weights(driver.policy).double().numpy()
    kept = folder / f"members-{ensemble.updates}-{ensemble.seed}"
    if kept.is_symlink():
        raise ValueError(f"{str(kept)!r} is a link, and nothing is written through one: remove it.")
    kept.mkdir(exist_ok=True)
    data = prepare_data(load_scenes(source)[0])
    members = []
    for number in track(range(ensemble.members), "members", console=Console(stderr=True), disable=not progress):
        path = kept / f"{number:03}.npz"
        if not path.exists():
            member = train_member(data, driver, base, folder / CHECKPOINT, ensemble, number)
            with replace_file(path) as draft:
                np.savez(draft, base=own, weights=member.weights, within=member.within)
        with open_ordinary(path) as file, np.load(file) as saved:
            if not np.array_equal(saved["base"], own):
                raise ValueError(f"{str(path)!r} is a member around another driver; remove {str(kept)!r}.")
            members.append(Member(saved["weights"], saved["within"]))
    return members


def make_ensemble(folder: Path, ensemble: Ensemble, out: Path, progress: bool = False) -> Path:
    """Write the driver of a finished training with a distribution of its weights to a `.safetensors` file."""
    members = train_members(folder, ensemble, progress)
    driver, provenance = read_driver(folder / DRIVER), read_provenance(folder / DRIVER)
    weights = np.stack([member.weights for member in members])
    fit = fit_weights(weights)
    bias = np.abs(weights.mean(axis=0) - head_weights(driver.policy).double().numpy())
    spreads = {
        "between": weights.std(axis=0, ddof=1),  # how far members are from each other
        "within": np.stack([member.within for member in members]).mean(axis=0),  # how far they move in their runs
        "bias": bias,
    }
    command = f"python -m training.imitation.weights RUN --members {ensemble.members} --updates {ensemble.updates}"
    about: dict[str, Any] = {"command": f"{command} --seed {ensemble.seed}"}
    for name, values in spreads.items():
        about |= {f"{name}_median": float(np.median(values)), f"{name}_max": float(values.max())}
    about["bias_over_spread"] = float(np.sqrt(np.square(bias).mean() / np.square(spreads["between"]).mean()))
    whole = replace(provenance, ensemble={**about, **fit.metadata})
    return save_driver(replace(driver, weights=fit.distribution), whole, out)


_FAILURES = (FloatingPointError, ConvergenceWarning, RuntimeWarning, np.linalg.LinAlgError)
"""Exceptions of the lasso if it has no answer, or one that is not positive definite."""


class WeightFit(NamedTuple):
    """A fitted distribution, and a record of the fit for JSON: what was chosen, and how each penalty did."""

    distribution: WeightDistribution
    metadata: dict[str, Any]


def fit_weights(
    members: FloatArray,
    *,
    penalties: Sequence[float] = PENALTIES,
    shrinkage: float = SHRINKAGE,
    folds: int = FOLDS,
    names: Sequence[str] = WEIGHT_NAMES,
) -> WeightFit:
    """Return the Gaussian N(mean, precision^-1) fitted to the last layers of K drivers, members (K, 404).

    Penalties are tried in descending order until one fails, on all members or without one of the folds, which hold out
    consecutive members; the one with the greatest held-out log-likelihood is taken. A search may move each mean by
    `RADIUS`. A ValueError says that a weight is not finite or the same in all, or that no penalty succeeds.
    """
    members = np.asarray(members, dtype=np.float64)
    held_out = np.array_split(np.arange(len(members)), folds)
    parts = [members, *(np.delete(members, fold, axis=0) for fold in held_out)]
    correlations = [_correlate(part, shrinkage, names) for part in parts]
    tried: list[dict[str, float]] = []
    precisions: list[FloatArray] = []
    stopped = "no penalty left"
    for penalty in penalties:
        try:
            precision, *others = (_lasso(correlation, penalty) for correlation in correlations)
            fitted = [_distribution(*part) for part in zip(parts[1:], others, strict=True)]
        except _FAILURES as failure:
            stopped = f"penalty {penalty} failed: {' '.join(str(failure).split())[:120]}"
            break
        scores = np.concatenate([part.log_prob(members[fold]) for part, fold in zip(fitted, held_out, strict=True)])
        beside = precision[~np.eye(len(precision), dtype=bool)]
        tried.append(
            {
                "penalty": float(penalty),
                "held_out_log_likelihood": float(scores.mean()),
                "nonzeros": float((beside != 0.0).mean()),
                "condition": float(np.linalg.cond(precision)),
            }
        )
        precisions.append(precision)
    if not tried:
        raise ValueError(f"No distribution could be fitted: {stopped}. Start at a larger penalty or shrink more.")
    best = int(np.argmax([row["held_out_log_likelihood"] for row in tried]))
    spread = members.std(axis=0, ddof=1)
    metadata = {
        "members": len(members),
        "folds": folds,
        "shrinkage": shrinkage,
        **tried[best],
        "spread_median": float(np.median(spread)),
        "spread_max": float(spread.max()),
        "stopped": stopped,
        "tried": tried,
    }
    return WeightFit(_distribution(members, precisions[best]), metadata)


def _distribution(members: FloatArray, precision: FloatArray) -> WeightDistribution:
    """Return the distribution around the mean of members with a precision of standardised weights."""
    spread = members.std(axis=0, ddof=1)
    return WeightDistribution(members.mean(axis=0), precision / np.outer(spread, spread), RADIUS)


def _correlate(members: FloatArray, shrinkage: float, names: Sequence[str]) -> FloatArray:
    """Return the correlation of members' weights, shrunk towards the identity; refuse inert weights."""
    inert = ~np.isfinite(members).all(axis=0) | (members == members[0]).all(axis=0)
    if inert.any():
        some = ", ".join(names[j] for j in np.flatnonzero(inert)[:5])
        raise ValueError(
            f"Expected every weight to vary among the members, but {inert.sum()} of {len(names)} are inert "
            f"(the same in all, or not finite): {some}{', ...' if inert.sum() > 5 else ''}. "
            "Does a clamp keep gradients from them?"
        )
    normal = (members - members.mean(axis=0)) / members.std(axis=0, ddof=1)
    correlation: FloatArray = (1.0 - shrinkage) * normal.T @ normal / (len(members) - 1)
    np.fill_diagonal(correlation, 1.0)
    return correlation


def _lasso(correlation: FloatArray, penalty: float) -> FloatArray:
    """Return the sparse precision of standardised weights; one of `_FAILURES` if no inner tolerance succeeds."""
    state = np.random.get_state()  # noqa: NPY002 - scikit-learn draws a number that nothing depends on
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for tolerance in INNER_TOLERANCES:
                try:
                    _, precision = graphical_lasso(correlation, penalty, tol=DUALITY_GAP, enet_tol=tolerance)
                    np.linalg.cholesky(precision)
                except _FAILURES:
                    if tolerance == INNER_TOLERANCES[-1]:
                        raise
                else:
                    break
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return np.asarray(precision, dtype=np.float64)


@use_one_thread()
def main(
    run: Annotated[Path, typer.Argument(help="Folder of a finished training.")],
    out: Annotated[Path, typer.Option(help="The driver with the distribution of its weights, .safetensors.")],
    members: Annotated[int, typer.Option(help="Members to train.")] = Ensemble.members,
    updates: Annotated[int, typer.Option(help="Of each member.")] = Ensemble.updates,
    seed: Annotated[int, typer.Option(help="The same seed gives the same distribution.")] = Ensemble.seed,
) -> None:
    """Train an ensemble around a driver and fit the distribution of its last layer's weights."""
    with report_errors("weights"):
        path = make_ensemble(run, Ensemble(members, updates, seed), out, progress=True)
    print(f"Saved {path}.")


if __name__ == "__main__":
    run_command(main)
