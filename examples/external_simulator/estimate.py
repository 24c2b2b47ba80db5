"""Probability of failure in a simulator that is another program: the sampler asks for scenarios, the simulator answers.

    python examples/external_simulator/estimate.py

The samplers never see the simulator: `start` needs a dimension and a base distribution, `ask` gives points, `tell`
takes their outcomes. Several processes share the points; one that dies is started again, and what it had not answered
is asked once more, so that the answer is the same. Any program that reads and writes such lines will do:
`estimate(["docker", "run", "-i", "mine"])`.
"""

import json
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import rare_envs
import samplers

SIMULATOR = (sys.executable, str(Path(__file__).with_name("simulator.py")))
MAX_STARTS = 5
"""Starts of a process that dies on the same points, before the run is given up."""


class ExternalSimulator:
    """A program that answers scenarios, one JSON object a line; started when it is needed, and again if it dies."""

    def __init__(self, command: Sequence[str], names: Sequence[str]) -> None:
        self.command, self.names = list(command), list(names)
        self.process: subprocess.Popen[str] | None = None

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the outcomes of scenarios x (n, d), shape (n,)."""
        f = np.full(len(x), np.nan)
        for _ in range(MAX_STARTS):
            try:
                self._ask(x, f)
                return f
            except (OSError, ValueError):  # it is gone, or its last line was cut
                self.close()
        raise RuntimeError(f"{self.command[0]} died {MAX_STARTS} times on the same scenarios.")

    def _ask(self, x: NDArray[np.float64], f: NDArray[np.float64]) -> None:
        """Fill in the outcomes that are missing."""
        if self.process is None:
            self.process = subprocess.Popen(self.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self.process.stdin is not None and self.process.stdout is not None
        for row in np.flatnonzero(np.isnan(f)):
            request = {"id": int(row), "x": dict(zip(self.names, x[row].tolist(), strict=True))}
            print(json.dumps(request), file=self.process.stdin, flush=True)
            answer = json.loads(self.process.stdout.readline())
            f[answer["id"]] = answer["f"]

    def close(self) -> None:
        """End the program."""
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None


def estimate(
    command: Sequence[str] = SIMULATOR, processes: int = 2, seed: int = 0, max_sim: int = 2000
) -> samplers.Estimate:
    """Return the probability of a collision in an external simulator, in scenarios of recorded car-following."""
    space = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0").space
    run = samplers.TwoStage().start(space, seed=seed, max_sim=max_sim)
    simulators = [ExternalSimulator(command, space.names) for _ in range(processes)]
    with ThreadPoolExecutor(processes) as pool:
        try:
            while not run.done:
                parts = np.array_split(run.ask(), processes)
                answers = pool.map(lambda simulator, x: simulator.evaluate(x), simulators, parts)
                run.tell(np.concatenate(list(answers)))
        finally:
            for simulator in simulators:
                simulator.close()
    return run.result()


if __name__ == "__main__":
    print(estimate())
