"""The driving scenarios with IDM as limit states, for bases whose p is known from 300 million rollouts.

A set for `benchmarks.estimators.two_stage.repeated_seeds --set` and for `study`. The truths are those of
`benchmarks/results/truth.json` (36,650, 77,499, 234,665 and 92,038 collisions: standard errors of 0.2 to 0.5 %).
"""

import json
from pathlib import Path

import rare_envs
from benchmarks.estimators.two_stage.blind_states import Make

TRUTH = Path(__file__).parents[2] / "results" / "truth.json"


def make() -> dict[str, Make]:
    """Return f in standard normal space, dimension and p by scenario and base."""
    return {
        f"{row['env_id'].split('/')[1].removesuffix('-v0')} {row['base']}": _driving_state(**row)
        for row in json.loads(TRUTH.read_text(encoding="utf-8"))["results"]
    }


def _driving_state(env_id: str, base: str, ego: str, p: float, **_: object) -> Make:
    problem = rare_envs.DrivingProblem(env_id, ego=ego, base=base)
    return lambda u: problem.evaluate(problem.base.from_standard_normal(u)), problem.dim, p
