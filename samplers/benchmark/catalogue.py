"""The problems of the sampler benchmark, with how each probability is known."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from samplers.benchmark.analytic_states import (
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
from samplers.benchmark.driving_models import car_following, cut_in
from samplers.benchmark.highdim_states import network, slabs, squares
from samplers.benchmark.public_states import PUBLIC_STATES
from samplers.limit_states import Reference, four_branches, half_space, parabola, plateau, shell

EXACT = "closed form or one-dimensional integral"
COUNTED = "4e7 plain draws (python -m benchmarks.estimators.network_references)"
SAMPLED = "3e6 draws from a fitted mixture (python -m benchmarks.estimators.driving_references)"


@dataclass(frozen=True)
class BenchmarkProblem:
    """A problem of the benchmark.

    Example:
        >>> PROBLEMS["lin_d2"].make().p, PROBLEMS["lin_d2"].group
        (0.00023262907903552502, 'analytic')
        >>> PROBLEMS["rp111_d2"].second
        'density of the product of two normal variables; weighted draws of f'
    """

    make: Callable[[], LimitState]
    group: str
    """The set that it is of: "analytic", "highdim" (30 dimensions and more), "public" or "driving"."""
    reference: str = EXACT
    """How its probability is known, in words; the standard error is that of the limit state."""
    draws: int = 0
    """Behind the probability; 0 for a closed form or an integral."""
    second: str = ""
    """Second, independent derivation, which the tests make."""
    rotation: int | None = None
    """Seed of the rotation of its input space, unless another one is asked for."""
    knowable: bool = True
    """False where no method can know of a region of failure: it then counts in no coverage."""


def _reference_state(reference: Callable[..., Reference], *args: float) -> Callable[[], LimitState]:
    return lambda: as_limit_state(reference(*args))


NEARER = "plain draws of f with its regions moved nearer"
_analytic = partial(BenchmarkProblem, group="analytic", second=NEARER)
_highdim = partial(BenchmarkProblem, group="highdim", second=NEARER)
_network = partial(
    BenchmarkProblem,
    group="highdim",
    reference=COUNTED,
    draws=40_000_000,
    second="plain draws of the inputs, not the layer",
)
_driving = partial(
    BenchmarkProblem,
    group="driving",
    reference=SAMPLED,
    draws=3_000_000,
    second="weighted draws from a wide normal law",
)

PROBLEMS: dict[str, BenchmarkProblem] = {
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
    "never_d4": _analytic(never, second="f of wide draws is positive"),
    # no proposal is to be found: dozens of regions, hundreds of dimensions without a direction
    "slabs_d20": _analytic(partial(slabs, 20, 4.5)),
    "slabs_d500": _highdim(partial(slabs, 500, 5.0)),
    "squares_d50": _highdim(partial(squares, 50, 1.0, 17.0)),
    "squares_d200": _highdim(partial(squares, 200, 0.5, 42.6)),
    "network_d30": _network(partial(network, 30)),
    "network_d400": _network(partial(network, 400)),
    # every evaluation adds fresh noise; no proposal in u can gain more than 413 and 35
    "noisy_d6": _analytic(partial(half_spaces, 6, (3.5,), noise=0.3), rotation=11),
    "noise2_d4": _analytic(partial(half_spaces, 4, (4.0, 4.2), noise=0.6), rotation=12),
    # driving
    "car_follow_d3": _driving(car_following),
    "cut_in_d6": _driving(cut_in),
    **{
        name: BenchmarkProblem(state.make, "public", state.reference, state.draws, state.second)
        for name, state in PUBLIC_STATES.items()
    },
}
