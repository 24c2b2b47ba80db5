"""The problems of the sampler benchmark by name and by set."""

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from benchmarks.samplers import limit_states as kinds
from benchmarks.samplers.fourth_states import FOURTH
from benchmarks.samplers.limit_states import LimitState, Seed, StrataState
from benchmarks.samplers.visible_states import VISIBLE
from samplers.limit_states import Reference, four_branches, half_space, parabola, plateau, shell


@dataclass(frozen=True)
class BenchmarkProblem:
    """A problem of the benchmark."""

    make: Callable[[], LimitState | StrataState]
    group: str
    """The set that it is of: one of `GROUPS`, or a file."""
    rotation: Seed | None = None
    """Seed of the rotation of its input space, unless another one is asked for."""
    knowable: bool = True
    """False where no method can know of a region of failure: it then counts in no coverage."""


def _reference_state(make: Callable[..., Reference], *args: float) -> Callable[[], LimitState]:
    return lambda: LimitState((one := make(*args)).problem.evaluate, one.problem.dim, one.p)


_visible = partial(BenchmarkProblem, group="visible")
_strata = partial(BenchmarkProblem, group="strata")
PROBLEMS: dict[str, BenchmarkProblem] = {
    # one region
    "lin_d2": _visible(_reference_state(half_space, 2)),
    "lin_d100": _visible(_reference_state(half_space, 100)),
    "lin_d500": _visible(_reference_state(half_space, 500)),
    "convex_d2": _visible(_reference_state(parabola), rotation=5),
    "sphere_d20": _visible(_reference_state(shell, 20, 1e-4)),
    "island_d3": _visible(partial(kinds.islands, [(2.5, 2.0, 0.0)], [0.35])),
    "corner_d5": _visible(partial(kinds.corner, 5, (1.6, 1.5, 1.2))),
    "ringpart_d10": _visible(kinds.ring_part),
    "strip_d4": _visible(kinds.strip),
    "plateau_d3": _visible(_reference_state(plateau)),
    # several regions
    "concave_d2": _visible(kinds.concave),
    "branch4_d2": _visible(_reference_state(four_branches)),
    "islands_d3": _visible(partial(kinds.islands, [(2.4, 1.8, 0.0), (-2.2, 0.0, -2.2)], [0.4, 0.5])),
    "common_d4": _visible(partial(kinds.half_spaces, 4, (2.0, 2.1))),
    "rare_d6": _visible(partial(kinds.half_spaces, 6, (5.0, 5.2)), rotation=9),
    "six_d8": _visible(
        partial(kinds.half_spaces, 8, (3.5, 3.6, 3.6, 3.7, 3.8, 3.9), (1, 3, 0.4, 1, 0.3, 2)), rotation=4
    ),
    "two_d10": _visible(partial(kinds.opposite, 10, 3.5, 4.0)),
    "two_d30": _visible(partial(kinds.half_spaces, 30, (3.4, 3.8)), rotation=1),
    "two_d60": _visible(partial(kinds.half_spaces, 60, (3.4, 3.6)), rotation=2),
    "four_d100": _visible(partial(kinds.half_spaces, 100, (3.5, 3.6, 3.7, 3.8)), rotation=3),
    # f leads away from the likelier region, or says nothing of it
    "deceptive_d2": _visible(partial(kinds.opposite, 2, 5.0, 3.5, (0.5, 10.0))),
    "decep_d8": _visible(partial(kinds.half_spaces, 8, (4.9, 3.5), (0.5, 10.0)), rotation=4),
    "decep_box_d3": _visible(kinds.hidden_box, knowable=False),
    "never_d4": _visible(kinds.never),
    # every evaluation adds fresh noise; no proposal in u can gain more than 413
    "noisy_d6": _visible(partial(kinds.half_spaces, 6, (3.5,), noise=0.3), rotation=11),
    **{name: _visible(make, rotation=seed and (20261122, seed)) for name, (make, seed) in VISIBLE.items()},
    **{name: BenchmarkProblem(make, "fourth", seed and (4, 1912, seed)) for name, (make, seed) in FOURTH.items()},
    # dozens of regions or directions: no proposal is to be found
    "slabs_d20": BenchmarkProblem(partial(kinds.slabs, 20, 4.5), "directionless"),
    "squares_d50": BenchmarkProblem(partial(kinds.squares, 50, 1.0, 17.0), "directionless"),
    # half-spaces in strata; 1.4e-4 is about the share of lane changes made without a look
    "strata_common": _strata(partial(StrataState, (0.6, 0.3, 0.1), (1e-2, 5e-2, 0.2))),
    "strata_looked": _strata(partial(StrataState, (0.98986, 0.01, 1.4e-4), (3e-5, 1e-3, 0.2))),
    "strata_rare": _strata(partial(StrataState, (0.98986, 0.01, 1.4e-4), (1e-6, 1e-3, 0.2))),
    # for the time that methods take for themselves
    "lin_d6": BenchmarkProblem(_reference_state(half_space, 6), "speed"),
    "lin_d428": BenchmarkProblem(_reference_state(half_space, 428), "speed"),
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
def limit_state(name: str) -> LimitState | StrataState:
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
