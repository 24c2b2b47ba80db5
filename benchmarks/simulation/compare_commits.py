r"""Is a command faster at one commit than at another? Both in turn, in work trees of their own.

    python -m benchmarks.simulation.compare_commits main~5 main --runs 7 -- python -m rare_envs estimate \
        rare_envs/CutIn-v0 --max-sim 6000 --json

The runs alternate and the order within a pair changes from pair to pair, so that a machine that slows down or speeds up
treats both alike. Times are processor times of the command and its children; the minimum is what the code needs, the
median what a user sees. A first pair, which fills caches, is not counted.
"""

import os
import resource
import shutil
import statistics
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

ROOT = Path(__file__).parents[2]


@contextmanager
def work_trees(commits: Sequence[str]) -> Iterator[list[Path]]:
    """Yield a folder with the files of each commit, and remove them at the end.

    Raises:
        ValueError: A commit is not known.
    """
    folder = Path(tempfile.mkdtemp(prefix="compare_commits_"))
    trees = [folder / str(number) for number in range(len(commits))]
    made: list[Path] = []
    try:
        for commit, tree in zip(commits, trees, strict=True):
            done = _git("worktree", "add", "--detach", str(tree), commit)
            if done.returncode:
                raise ValueError(f"Cannot check out {commit!r}: {done.stderr.strip().splitlines()[-1]}")
            made.append(tree)
        yield trees
    finally:
        for tree in made:
            _git("worktree", "remove", "--force", str(tree))
        shutil.rmtree(folder, ignore_errors=True)


def _git(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)


def measure_command(command: Sequence[str], tree: Path) -> float:
    """Return the processor time [s] of a command that runs the packages of a work tree.

    Raises:
        ValueError: The command failed.
    """
    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 3):  # 3: an estimate with warnings
        said = (done.stderr or done.stdout).strip().splitlines() or ["nothing was printed"]
        raise ValueError(f"The command ended with {done.returncode} in {tree}: {said[-1]}")
    return (after.ru_utime - before.ru_utime) + (after.ru_stime - before.ru_stime)


def compare_trees(command: Sequence[str], trees: Sequence[Path], runs: int) -> list[list[float]]:
    """Return the times [s] of a command in two work trees, in turn, after a pair that is not counted."""
    times: list[list[float]] = [[], []]
    for pair in range(runs + 1):
        for side in (0, 1) if pair % 2 else (1, 0):
            seconds = measure_command(command, trees[side])
            if pair:
                times[side].append(seconds)
    return times


def describe_times(names: Sequence[str], times: Sequence[Sequence[float]]) -> str:
    """Return minimum and median of both sides, and the ratios of the second to the first.

    Example:
        >>> print(describe_times(["main~1", "main"], [[2.0, 2.2, 2.1], [1.0, 1.2, 1.1]]))
        main~1      minimum 2.00 s, median 2.10 s
        main        minimum 1.00 s, median 1.10 s
        main / main~1: minimum 0.50, median 0.52; faster in 3 of 3 pairs
    """
    lines = [
        f"{name:<11} minimum {min(own):.2f} s, median {statistics.median(own):.2f} s"
        for name, own in zip(names, times, strict=True)
    ]
    first, second = times
    faster = sum(b < a for a, b in zip(first, second, strict=True))
    lowest, usual = min(second) / min(first), statistics.median(second) / statistics.median(first)
    pairs = f"faster in {faster} of {len(first)} pairs"
    return "\n".join([*lines, f"{names[1]} / {names[0]}: minimum {lowest:.2f}, median {usual:.2f}; {pairs}"])


def main(
    first: Annotated[str, typer.Argument(help="Commit.")],
    second: Annotated[str, typer.Argument(help="Commit that it is compared with.")],
    command: Annotated[list[str], typer.Argument(help="The command, after --.")],
    runs: Annotated[int, typer.Option(min=1, help="Pairs of runs.")] = 5,
) -> None:
    """Time a command at two commits in alternating pairs."""
    try:
        with work_trees([first, second]) as trees:
            print(describe_times([first, second], compare_trees(command, trees, runs)))
    except ValueError as error:
        raise SystemExit(f"compare_commits: {error}") from None


if __name__ == "__main__":
    typer.run(main)
