"""The problems that the methods are measured on, and what the default method is expected to reach on each."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from benchmarks.estimators.driving_models import car_following, cut_in
from benchmarks.estimators.high_dimensional import network, slabs, squares
from benchmarks.estimators.limit_states import (
    LimitState,
    as_limit_state,
    bowl,
    concave,
    corner,
    half_spaces,
    hidden_box,
    islands,
    never,
    opposite,
    ring_part,
    round_to_steps,
    strip,
)
from samplers.limit_states import Reference, four_branches, half_space, parabola, plateau, shell


@dataclass(frozen=True)
class BenchmarkCase:
    """A problem of the benchmark and its targets for the default method at 6,000 simulations."""

    make: Callable[[], LimitState]
    min_gain: float | None = None
    """Least gain over plain Monte Carlo at equal error."""
    min_coverage: float | None = 0.88
    """Least coverage of the 95 % interval; None where a region of failure cannot be known of."""
    rotation: int | None = None
    """Seed of the rotation of its input space, unless another one is asked for."""


def _reference_state(reference: Callable[..., Reference], *args: float) -> Callable[[], LimitState]:
    return lambda: as_limit_state(reference(*args))


CASES: dict[str, BenchmarkCase] = {
    # one region
    "lin_d2": BenchmarkCase(_reference_state(half_space, 2), 3000),
    "lin_d100": BenchmarkCase(_reference_state(half_space, 100), 3000),
    "lin_d500": BenchmarkCase(_reference_state(half_space, 500), 1500),
    "convex_d2": BenchmarkCase(_reference_state(parabola), 3000, rotation=5),
    "curved_d20": BenchmarkCase(partial(bowl, 20, 2.6, 0.05), rotation=6),
    "sphere_d20": BenchmarkCase(_reference_state(shell, 20, 1e-4), 3000),
    "island_d3": BenchmarkCase(partial(islands, [(2.5, 2.0, 0.0)], [0.35]), 3000),
    "corner_d5": BenchmarkCase(partial(corner, 5, (1.6, 1.5, 1.2)), 200),
    "ringpart_d10": BenchmarkCase(ring_part),
    "strip_d4": BenchmarkCase(strip),
    "plateau_d3": BenchmarkCase(_reference_state(plateau), 3000),
    # several regions
    "concave_d2": BenchmarkCase(concave, 200),
    "branch4_d2": BenchmarkCase(_reference_state(four_branches), 200),
    "islands_d3": BenchmarkCase(partial(islands, [(2.4, 1.8, 0.0), (-2.2, 0.0, -2.2)], [0.4, 0.5])),
    "common_d4": BenchmarkCase(partial(half_spaces, 4, (2.0, 2.1))),
    "three_d6": BenchmarkCase(partial(half_spaces, 6, (3.5, 3.7, 3.9), (1.0, 3.0, 0.4)), rotation=8),
    "rare_d6": BenchmarkCase(partial(half_spaces, 6, (5.0, 5.2)), rotation=9),
    "steps_d6": BenchmarkCase(lambda: round_to_steps(half_spaces(6, (3.5, 4.0))), rotation=10),
    "six_d8": BenchmarkCase(
        partial(half_spaces, 8, (3.5, 3.6, 3.6, 3.7, 3.8, 3.9), (1, 3, 0.4, 1, 0.3, 2)), 50, rotation=4
    ),
    "two_d10": BenchmarkCase(partial(opposite, 10, 3.5, 4.0), 500),
    "two_d30": BenchmarkCase(partial(half_spaces, 30, (3.4, 3.8)), 50, rotation=1),
    "two_d60": BenchmarkCase(partial(half_spaces, 60, (3.4, 3.6)), 50, rotation=2),
    "four_d100": BenchmarkCase(partial(half_spaces, 100, (3.5, 3.6, 3.7, 3.8)), 50, rotation=3),
    # f leads away from the likelier region, or says nothing of it
    "deceptive_d2": BenchmarkCase(partial(opposite, 2, 5.0, 3.5, (0.5, 10.0)), 3000),
    "decep_d8": BenchmarkCase(partial(half_spaces, 8, (4.9, 3.5), (0.5, 10.0)), 1500, rotation=4),
    "decep_box_d3": BenchmarkCase(hidden_box, min_coverage=None),
    "never_d4": BenchmarkCase(never),
    # no proposal is to be found: dozens of regions, hundreds of dimensions without a direction
    "slabs_d20": BenchmarkCase(partial(slabs, 20, 4.5)),
    "slabs_d500": BenchmarkCase(partial(slabs, 500, 5.0)),
    "squares_d50": BenchmarkCase(partial(squares, 50, 1.0, 17.0)),
    "squares_d200": BenchmarkCase(partial(squares, 200, 0.5, 42.6)),
    "network_d30": BenchmarkCase(partial(network, 30)),
    "network_d400": BenchmarkCase(partial(network, 400)),
    # every evaluation adds fresh noise; no proposal in u can gain more than 413 and 35
    "noisy_d6": BenchmarkCase(partial(half_spaces, 6, (3.5,), noise=0.3), 150, rotation=11),
    "noise2_d4": BenchmarkCase(partial(half_spaces, 4, (4.0, 4.2), noise=0.6), 6, min_coverage=0.90, rotation=12),
    # driving
    "car_follow_d3": BenchmarkCase(car_following, 1500),
    "cut_in_d6": BenchmarkCase(cut_in, 2500),
}
