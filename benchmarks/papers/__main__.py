"""Tables and figures of published papers, made anew and set beside those that were printed.

    python -m benchmarks.papers tian2024 --out runs/tian2024 --scale small
    python -m benchmarks.papers okelly2018 --out runs/okelly2018 --ego vision --at-most 2000

Each writes `reproduction.json`, `reproduction.md` and figures, and the single runs, with which the same command goes
on.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks.papers.okelly2018.reproduction import reproduce_okelly2018
from benchmarks.papers.okelly2018.study import HighwayStudy, RolloutFolder
from benchmarks.papers.tian2024.replications import SCALES, TianPlan
from benchmarks.papers.tian2024.study import reproduce_tian2024
from rare_envs.startup import use_one_thread
from rare_envs.study.arguments import BadInput


def main(words: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 0 done, 2 bad input."""
    arguments = _make_parser().parse_args(words)
    try:
        with use_one_thread():
            _COMMANDS[arguments.command](arguments)
    except (BadInput, ValueError, OSError) as error:
        print(f"benchmarks.papers: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("The runs so far are in the folder; the same command goes on with them.", file=sys.stderr)
        return 130
    return 0


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.papers", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    tian = commands.add_parser("tian2024", help="Tian et al. 2024: Tables II and III, Figures 6 to 8")
    tian.add_argument("--scale", choices=SCALES, default="full", help="5 replications of every method, or 20")
    tian.add_argument("--replications", type=int, help="of every method, instead of the scale's")
    tian.add_argument("--seed", type=int, default=0, help="of the first replication")
    okelly = commands.add_parser("okelly2018", help="O'Kelly et al. 2018: Tables 1 and 2, Figures 2 and 3")
    okelly.add_argument("--scale", default="small", help="small, or full: the paper's, for days")
    okelly.add_argument("--ego", default="lidar", help="lidar (Table 1, Figure 2) or vision (Table 2, Figure 3)")
    okelly.add_argument("--seed", type=int, default=2018, help="of all draws")
    okelly.add_argument("--at-most", type=int, help="rollouts to make now; the record says what is not run")
    for command, name in ((tian, "tian2024"), (okelly, "okelly2018")):
        command.add_argument("--out", type=Path, default=Path(name), help="folder of runs and record")
        command.add_argument("--workers", type=int, default=1, help="processes")
        command.add_argument("--json", action="store_true", help="print the record")
    return parser


def _run_tian(arguments: argparse.Namespace) -> None:
    plan = TianPlan(arguments.replications or SCALES[arguments.scale], arguments.seed)
    command = f"python -m benchmarks.papers tian2024 --replications {plan.replications} --seed {plan.seed}"
    record = reproduce_tian2024(plan, arguments.out, command, arguments.workers, progress=True)
    _tell(record, arguments)


def _run_okelly(arguments: argparse.Namespace) -> None:
    if arguments.at_most is not None and arguments.at_most < 0:
        raise BadInput(f"Expected --at-most to be 0 or more, got {arguments.at_most}.")
    study = HighwayStudy(arguments.ego, arguments.scale, arguments.seed)
    command = (
        f"python -m benchmarks.papers okelly2018 --scale {study.scale} --ego {study.ego} --seed {study.seed} "
        "--out FOLDER"
    )
    with _open_workers(arguments.workers) as executor:
        problem = study.make_problem()
        rollouts = RolloutFolder(study, arguments.out, problem, executor, arguments.at_most, progress=True)
        record = reproduce_okelly2018(rollouts, command)
    _tell(record, arguments)


def _open_workers(workers: int) -> AbstractContextManager[Executor | None]:
    if workers < 1:
        raise BadInput(f"Expected --workers to be 1 or more, got {workers}.")
    return nullcontext() if workers == 1 else ProcessPoolExecutor(workers, mp_context=get_context("spawn"))


def _tell(record: Mapping[str, Any], arguments: argparse.Namespace) -> None:
    if arguments.json:
        print(json.dumps(record))
        return
    for note in record["notes"]:
        print(note)
    for found in record["findings"]:
        print(f"{found['claim']}: {found['verdict']}. {found['statistic']}.")
    print(f"Wrote {arguments.out / 'reproduction.json'} and {arguments.out / 'reproduction.md'}.")


_COMMANDS = {"tian2024": _run_tian, "okelly2018": _run_okelly}

if __name__ == "__main__":
    sys.exit(main())
