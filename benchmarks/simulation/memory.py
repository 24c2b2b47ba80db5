"""Memory of plain Monte Carlo over the number of simulations: of the estimate alone, and with journal and table.

Each number of simulations has a process of its own, whose largest resident set is read at its end. f is that of a half
space, so that nothing but the bookkeeping counts: 2 dimensions, P = Phi(-3).

    python -m benchmarks.simulation.memory --out benchmarks/results/run_memory.json
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from rare_envs.files import replace_text

CODE = """
import resource, sys
import numpy as np
import samplers

n, table = int(sys.argv[1]), sys.argv[2] == "table"
space = None
if table:
    from pathlib import Path
    import rare_envs
    from rare_envs.study.episodes import EpisodeTable
    from samplers.evaluate import Simulated
    space = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").space
    episodes = EpisodeTable(Path(sys.argv[3]), space)

def f(x):
    out = 3.0 - x[:, 0]
    if table:
        rows = np.column_stack((x, x[:, :1]))
        episodes.add(Simulated(rows, out, [], np.zeros(len(x))))
    return out

before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
journal = sys.argv[3] + "/journal.bin" if table else None
problem = samplers.FunctionProblem(f, dim=2)
result = samplers.estimate(problem, "mc", seed=0, max_sim=n, journal=journal)
if table:
    episodes.write(result, {})
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(result.p, before / 1024, after / 1024)
"""


def measure(n: int, table: bool) -> dict[str, object]:
    """Return the largest resident set [MiB] before and after n simulations, in a process of its own."""
    with TemporaryDirectory() as folder:
        words = [sys.executable, "-c", CODE, str(n), "table" if table else "estimate", folder]
        p, before, after = subprocess.run(words, check=True, capture_output=True, text=True).stdout.split()
    return {
        "n": n,
        "with": "journal and table" if table else "estimate",
        "p": float(p),
        "before": float(before),
        "after": float(after),
    }


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--estimate", type=int, nargs="+", default=[10**6, 10**7, 10**8])
    parser.add_argument("--table", type=int, nargs="+", default=[10**6, 10**7])
    arguments = parser.parse_args()
    rows = []
    for n, table in [*((n, False) for n in arguments.estimate), *((n, True) for n in arguments.table)]:
        rows.append(measure(n, table))
        print(rows[-1], flush=True)
        if arguments.out:
            content = {
                "command": f"python -m benchmarks.simulation.memory --out {arguments.out}",
                "unit": "MiB",
                "rows": rows,
            }
            replace_text(arguments.out, json.dumps(content, indent=2) + "\n")


if __name__ == "__main__":
    main()
