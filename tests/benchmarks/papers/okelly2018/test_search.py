"""Algorithm 1 by hand."""

import numpy as np
import pytest

from benchmarks.papers.okelly2018.scales import SearchSettings
from benchmarks.papers.okelly2018.search import (
    choose_sampler,
    describe_sampler,
    draw_chunk,
    find_log_ratios,
    make_base,
    take_step,
)
from samplers import FunctionProblem
from samplers.methods.blocks import BetaBlock, NormalBlock, Product
from samplers.proposals import Gaussian

BASE = Product(
    (
        BetaBlock(alpha=np.full(2, 2.0), beta=2.0, low=0.0, high=10.0),
        NormalBlock(Gaussian.standard(3), radius=0.5),
    )
)


def inputs() -> FunctionProblem:
    return FunctionProblem(lambda x: x[:, 0], dim=5, base=BASE)


def test_a_step_moves_towards_small_outcomes_within_the_box() -> None:
    x = draw_chunk(BASE, 2000, 0, "a")
    f = x[:, 0] - 2.0 * x[:, 3]
    step, sampler = take_step(BASE, BASE, x, f, SearchSettings(0.1), gamma=-100.0)
    assert step.level == step.quantile == np.sort(f)[199]
    assert step.elite == 200
    assert step.ess == pytest.approx(200.0)
    moved = describe_sampler(BASE, sampler)
    assert moved["mean"][0] < 4.0 < moved["mean"][1] < 6.0  # type: ignore[index, operator]
    assert moved["largest_shift"] == pytest.approx(0.5)


def test_the_level_stops_at_gamma() -> None:
    x = draw_chunk(BASE, 1000, 0, "a")
    step, _ = take_step(BASE, BASE, x, x[:, 0], SearchSettings(0.1), gamma=5.0)
    assert step.level == 5.0 > step.quantile
    assert step.elite == (x[:, 0] <= 5.0).sum()


def test_weights_that_do_not_move_stay() -> None:
    base = make_base(inputs(), SearchSettings(0.1, weights_move=False))
    x = draw_chunk(base, 1000, 0, "a")
    _, sampler = take_step(base, base, x, x[:, 0] - x[:, 3], SearchSettings(0.1, weights_move=False), gamma=-100.0)
    moved = describe_sampler(base, sampler)
    assert moved["largest_shift"] == moved["shift"] == 0.0
    assert moved["mean"][0] < 4.0  # type: ignore[index, operator]


def test_draws_are_those_of_seed_and_key() -> None:
    assert (draw_chunk(BASE, 5, 1, "naive/0") == draw_chunk(BASE, 5, 1, "naive/0")).all()
    assert (draw_chunk(BASE, 5, 1, "naive/0") != draw_chunk(BASE, 5, 1, "naive/1")).any()
    assert (draw_chunk(BASE, 5, 1, "naive/0") != draw_chunk(BASE, 5, 2, "naive/0")).any()


def test_likelihood_ratios_have_mean_1() -> None:
    near = Product((BetaBlock(alpha=np.full(2, 2.5), beta=2.0, low=0.0, high=10.0), BASE.blocks[1]))
    x = draw_chunk(near, 20_000, 0, "a")
    assert np.exp(find_log_ratios(BASE, near, x)).mean() == pytest.approx(1.0, abs=0.02)


def test_the_lowest_quantile_is_chosen() -> None:
    x = draw_chunk(BASE, 100, 0, "a")
    steps = [take_step(BASE, BASE, x, x[:, 0] + shift, SearchSettings(0.1), -9.0)[0] for shift in (1.0, 0.0, 0.0)]
    assert choose_sampler(steps) == 1


def test_variances_are_those_of_the_beta_variables() -> None:
    assert describe_sampler(BASE, BASE)["variance"] == pytest.approx([5.0, 5.0])  # 100 / 20
