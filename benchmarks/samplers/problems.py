"""The problems of the sampler benchmark by name and by set."""

import importlib.util
import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from benchmarks import RESULTS
from benchmarks.samplers.fresh_states import BLIND, HELD_OUT
from benchmarks.samplers.limit_states import (
    LimitState,
    as_limit_state,
    bowl,
    concave,
    corner,
    half_spaces,
    hidden_box,
    islands,
    network,
    never,
    opposite,
    ring_part,
    round_to_steps,
    slabs,
    squares,
    strip,
)
from benchmarks.samplers.public_states import PUBLIC_STATES
from samplers.limit_states import Reference, four_branches, half_space, parabola, plateau, shell


@dataclass(frozen=True)
class BenchmarkProblem:
    """A problem of the benchmark."""

    make: Callable[[], LimitState]
    group: str
    """The set that it is of: one of `GROUPS` ("highdim": 30 dimensions and more), or a file."""
    rotation: int | None = None
    """Seed of the rotation of its input space, unless another one is asked for."""
    knowable: bool = True
    """False where no method can know of a region of failure: it then counts in no coverage."""


def _reference_state(reference: Callable[..., Reference], *args: float) -> Callable[[], LimitState]:
    return lambda: as_limit_state(reference(*args))


def _collide(env_id: str, base: str) -> LimitState:
    """Return a scenario with the IDM as ego, whose collisions were counted (`truth.json`), in N(0, I)."""
    from rare_envs.problem import DrivingProblem  # the other problems need no torch

    rows = json.loads((RESULTS / "truth.json").read_text(encoding="utf-8"))["results"]
    (row,) = (row for row in rows if (row["env_id"], row["base"]) == (env_id, base))
    problem = DrivingProblem(env_id, base=base)
    return LimitState(
        lambda u: problem.evaluate(problem.base.from_standard_normal(u)), problem.dim, row["p"], row["standard_error"]
    )


_analytic = partial(BenchmarkProblem, group="analytic")
_highdim = partial(BenchmarkProblem, group="highdim")
_driving = partial(BenchmarkProblem, group="driving")

PROBLEMS: dict[str, BenchmarkProblem] = {
    # for the time that methods take for themselves
    "lin_d6": BenchmarkProblem(_reference_state(half_space, 6), "speed"),
    "lin_d428": BenchmarkProblem(_reference_state(half_space, 428), "speed"),
    # one region
    "lin_d2": _analytic(_reference_state(half_space, 2)),
    "lin_d100": _highdim(_reference_state(half_space, 100)),
    "lin_d500": _highdim(_reference_state(half_space, 500)),
    "convex_d2": _analytic(_reference_state(parabola), rotation=5),
    "curved_d20": _analytic(partial(bowl, 20, 2.6, 0.05), rotation=6),
    "sphere_d20": _analytic(_reference_state(shell, 20, 1e-4)),
    "island_d3": _analytic(partial(islands, [(2.5, 2.0, 0.0)], [0.35])),
    "corner_d5": _analytic(partial(corner, 5, (1.6, 1.5, 1.2))),
    "ringpart_d10": _analytic(ring_part),
    "strip_d4": _analytic(strip),
    "plateau_d3": _analytic(_reference_state(plateau)),
    # several regions
    "concave_d2": _analytic(concave),
    "branch4_d2": _analytic(_reference_state(four_branches)),
    "islands_d3": _analytic(partial(islands, [(2.4, 1.8, 0.0), (-2.2, 0.0, -2.2)], [0.4, 0.5])),
    "common_d4": _analytic(partial(half_spaces, 4, (2.0, 2.1))),
    "three_d6": _analytic(partial(half_spaces, 6, (3.5, 3.7, 3.9), (1.0, 3.0, 0.4)), rotation=8),
    "rare_d6": _analytic(partial(half_spaces, 6, (5.0, 5.2)), rotation=9),
    "steps_d6": _analytic(lambda: round_to_steps(half_spaces(6, (3.5, 4.0))), rotation=10),
    "six_d8": _analytic(partial(half_spaces, 8, (3.5, 3.6, 3.6, 3.7, 3.8, 3.9), (1, 3, 0.4, 1, 0.3, 2)), rotation=4),
    "two_d10": _analytic(partial(opposite, 10, 3.5, 4.0)),
    "two_d30": _highdim(partial(half_spaces, 30, (3.4, 3.8)), rotation=1),
    "two_d60": _highdim(partial(half_spaces, 60, (3.4, 3.6)), rotation=2),
    "four_d100": _highdim(partial(half_spaces, 100, (3.5, 3.6, 3.7, 3.8)), rotation=3),
    # f leads away from the likelier region, or says nothing of it
    "deceptive_d2": _analytic(partial(opposite, 2, 5.0, 3.5, (0.5, 10.0))),
    "decep_d8": _analytic(partial(half_spaces, 8, (4.9, 3.5), (0.5, 10.0)), rotation=4),
    "decep_box_d3": _analytic(hidden_box, knowable=False),
    "never_d4": _analytic(never),
    # no proposal is to be found: dozens of regions, hundreds of dimensions without a direction
    "slabs_d20": _analytic(partial(slabs, 20, 4.5)),
    "slabs_d500": _highdim(partial(slabs, 500, 5.0)),
    "squares_d50": _highdim(partial(squares, 50, 1.0, 17.0)),
    "squares_d200": _highdim(partial(squares, 200, 0.5, 42.6)),
    "network_d30": _highdim(partial(network, 30)),
    "network_d400": _highdim(partial(network, 400)),
    # every evaluation adds fresh noise; no proposal in u can gain more than 413 and 35
    "noisy_d6": _analytic(partial(half_spaces, 6, (3.5,), noise=0.3), rotation=11),
    "noise2_d4": _analytic(partial(half_spaces, 4, (4.0, 4.2), noise=0.6), rotation=12),
    # scenarios
    "following_us101_d3": _driving(partial(_collide, "rare_envs/CarFollowing-v0", "us101-gap")),
    "following_highway_d3": _driving(partial(_collide, "rare_envs/CarFollowing-v0", "highway")),
    "cut_in_us101_d6": _driving(partial(_collide, "rare_envs/CutIn-v0", "us101-15-offsets")),
    "cut_in_highway_d6": _driving(partial(_collide, "rare_envs/CutIn-v0", "highway")),
    **{name: BenchmarkProblem(partial(getattr, public, "state"), "public") for name, public in PUBLIC_STATES.items()},
    **{state.__name__: BenchmarkProblem(state, "blind") for state in BLIND},
    **{state.__name__: BenchmarkProblem(state, "held-out") for state in HELD_OUT},
}
GROUPS = tuple(dict.fromkeys(problem.group for problem in PROBLEMS.values()))
"""Names of the sets."""


def list_problems(group: str) -> list[str]:
    """Return the names of the problems of a set, or of a file whose `make()` returns {name: (f, dim, p, ...)}.

    Those of a file are named FILE:NAME.

    Raises:
        ValueError: There is no such set, and no such file.
    """
    if group in GROUPS:
        return [name for name, problem in PROBLEMS.items() if problem.group == group]
    if not Path(group).is_file():
        raise ValueError(f"Unknown set {group!r}; known: {', '.join(GROUPS)}, or a file of limit states.")
    return [f"{group}:{name}" for name in _load_file(group)]


@cache
def find_problem(name: str) -> BenchmarkProblem:
    """Return a problem by its name, or by that of its file and its name there.

    Raises:
        ValueError: There is no such problem.
    """
    file, _, own = name.rpartition(":")
    if file and own in (found := _load_file(file)):
        return BenchmarkProblem(lambda: found[own], file)
    if name not in PROBLEMS:
        raise ValueError(f"Unknown problem {name!r}; known: {', '.join(PROBLEMS)}.")
    return PROBLEMS[name]


@cache
def limit_state(name: str) -> LimitState:
    """Return the limit state of a problem; its p is computed once."""
    return find_problem(name).make()


@cache
def _load_file(path: str) -> dict[str, LimitState]:
    """Return the limit states of a file: its `make()` gives tuples (f, d, p, ...), or objects with g, d and p."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, path)
    assert spec is not None and spec.loader is not None, path
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {
        name: LimitState(*(state[:3] if isinstance(state, tuple) else (state.g, state.d, state.p)))
        for name, state in module.make().items()
    }
