"""Strata and accepted gaps: exact maps, densities that integrate to one, and shares that are as said."""

import itertools

import numpy as np
import pytest
from scipy import integrate, stats

from rare_envs.distributions import (
    AcceptedGaps,
    Coordinates,
    CutNormals,
    EventCounts,
    FittedDistribution,
    NoiseDistribution,
    StratifiedDistribution,
    Stratum,
    TruncatedGaussianMixture,
    join_independent,
)
from rare_envs.distributions.acceptance import log_acceptance, needed_after
from rare_envs.scenarios.base import load_base
from rare_envs.scenarios.registry import find_scenario

LIMIT = -3.6334
NAMES = ("ego_speed", "cut_in_speed", "lead_speed", "cut_in_gap")


def make_gaps(limit: float, components: int = 1) -> AcceptedGaps:
    """Return starts with closing speeds and gaps as on US 101."""
    coordinates = Coordinates(
        low=[0.0, -45.0, 0.0, 1.0],
        high=[45.0, 45.0, 45.0, 120.0],
        kinds=("plain", "plain", "plain", "log"),
        names=NAMES,
        order=("cut_in_speed", "cut_in_gap", "ego_speed", "lead_speed"),
        within=(("ego_speed", "cut_in_speed", 0.0, 45.0),),
    )
    sd = np.array([2.0, 0.7, 2.3, 2.4])
    correlation = np.array([[1.0, 0.2, 0.3, 0.1], [0.2, 1.0, 0.1, 0.2], [0.3, 0.1, 1.0, 0.8], [0.1, 0.2, 0.8, 1.0]])
    means = [[-0.8, 2.84, 14.4, 15.7], [2.0, 2.0, 12.0, 12.0]][:components]
    covariances = [correlation * np.outer(sd, sd)] * components
    weights = [1.0] if components == 1 else [0.7, 0.3]
    return AcceptedGaps(TruncatedGaussianMixture(weights, means, covariances, coordinates=coordinates), limit)


def make_strata(share: float = 1.4e-4, limit: float = 0.5) -> StratifiedDistribution:
    """Return drivers who looked, with accepted gaps, and who did not, with any."""
    gaps = make_gaps(limit)
    any_gap = TruncatedGaussianMixture(
        [1.0],
        [[14.0, 14.0, 14.0, 5.0]],
        [np.diag([9.0, 9.0, 9.0, 100.0])],
        [0.0, 0.0, 0.0, -10.0],
        [45.0] * 3 + [120.0],
    )
    parts = ("unseen", share, any_gap, [-np.inf], [LIMIT]), ("looked", 1.0 - share, gaps, [LIMIT], [np.inf])
    strata = [Stratum(name, w, join_independent(base, CutNormals(*ends))) for name, w, base, *ends in parts]
    return StratifiedDistribution(tuple(strata), [LIMIT], column=4)


@pytest.mark.parametrize(("limit", "components"), [(0.1, 1), (0.5, 1), (5.0, 1), (0.5, 2)])
def test_accepted_starts_are_draws_of_the_mixture_that_a_driver_accepts(limit: float, components: int) -> None:
    """Draws by rejection are standard normal in u (Kolmogorov-Smirnov, 4 tests each), and Z is the share accepted."""
    gaps, rng = make_gaps(limit, components), np.random.default_rng(1)
    z = gaps.mixture.sample(60_000, rng)
    accepted = np.exp(log_acceptance(z[:, 3], z[:, 1], limit))
    error = accepted.std() / np.sqrt(len(z))
    assert np.exp(gaps.log_share) == pytest.approx(accepted.mean(), abs=4 * error)
    x = z[rng.random(len(z)) < accepted]
    x[:, 1] = x[:, 0] - x[:, 1]
    u = gaps.to_standard_normal(x)
    assert min(stats.kstest(u[:, j], "norm").pvalue for j in range(4)) > 1e-4
    assert np.abs(np.corrcoef(u.T) - np.eye(4)).max() < 4.5 / np.sqrt(len(u))


@pytest.mark.parametrize("limit", [0.1, 0.5, 20.0])
def test_maps_of_accepted_starts_are_exact_and_have_their_density(limit: float) -> None:
    """u -> x -> u to 1e-7 for |u| <= 6, and p(x) |det dx/du| = phi(u), by central differences of the map."""
    gaps, rng = make_gaps(limit, 2), np.random.default_rng(2)
    u = np.clip(2.5 * rng.standard_normal((2000, 4)), -6.0, 6.0)
    x = gaps.from_standard_normal(u)
    assert np.abs(gaps.to_standard_normal(x) - u).max() < 2e-7
    assert np.array_equal(gaps.from_standard_normal(u[7:8]), x[7:8])
    u = np.clip(u[:200], -3.0, 3.0)
    step = 1e-4 * np.eye(4)
    columns = [(gaps.from_standard_normal(u + h) - gaps.from_standard_normal(u - h)) / 2e-4 for h in step]
    log_det = np.linalg.slogdet(np.stack(columns, axis=2)).logabsdet
    expected = stats.norm.logpdf(u).sum(axis=1)
    assert gaps.log_prob(gaps.from_standard_normal(u)) + log_det == pytest.approx(expected, abs=2e-5)


def test_the_tail_of_closing_speeds_is_that_of_the_integral() -> None:
    """P[closing > 5 m/s], 1e-4 of the accepted starts, by integration over closing speed and gap."""
    gaps = make_gaps(0.5)
    plain = gaps.mixture

    def density(y: float, closing: float) -> float:
        mean = 2.84 + 0.2 * 0.7 / 2.0 * (closing + 0.8)
        mass = np.diff(stats.norm.cdf(np.log([1.0, 120.0]), mean, 0.7 * np.sqrt(0.96)))[0]
        own = stats.norm.pdf(closing, -0.8, 2.0) * stats.norm.pdf(y, mean, 0.7 * np.sqrt(0.96)) / mass
        return float(own / (1.0 + (needed_after(np.exp(y), closing) / 0.5) ** 4))

    above, _ = integrate.dblquad(density, 5.0, 15.0, np.log(5.0), np.log(120.0), epsabs=1e-10, epsrel=1e-9)
    expected = stats.norm.isf(above / np.exp(gaps.log_share))
    x = gaps.from_standard_normal([[0.0, -expected, 0.0, 0.0]])
    assert x[0, 0] - x[0, 1] == pytest.approx(5.0, abs=1e-6)
    assert gaps.log_prob(x) < plain.log_prob([[x[0, 0], 5.0, *x[0, 2:]]]) - gaps.log_share


def test_strata_have_their_shares_and_maps_that_are_precise_in_both_tails() -> None:
    """One in 7,143 has not looked, whatever the other columns; u -> x -> u, far out in the column that decides too."""
    both, rng = make_strata(), np.random.default_rng(3)
    u = rng.standard_normal((4000, 5))
    u[:, 4] = np.linspace(-9.0, 9.0, len(u))
    x = both.from_standard_normal(u)
    assert np.abs(both.to_standard_normal(x) - u).max() < 1e-7
    unseen = u[:, 4] < stats.norm.ppf(1.4e-4)
    assert np.array_equal(x[:, 4] < LIMIT, unseen)
    assert (x[~unseen, 3] >= 1.0).all() and (x[unseen, 3] < 0.0).any()
    parts = np.stack([each.base.log_prob(x) + np.log(each.share) for each in both.strata])
    assert both.log_prob(x) == pytest.approx(np.logaddexp(*parts))
    assert np.array_equal(both.sample(5, np.random.default_rng(0)), both.sample(9, np.random.default_rng(0))[:5])


def test_strata_are_passed_on_by_noise_and_fits_and_refits_have_their_own() -> None:
    base = FittedDistribution(
        distribution=make_strata(),
        refits=(make_strata(3e-4, 0.8), make_strata(1e-4, 0.3)),
        events=EventCounts(used=(38,), clusters=17),
        family="accepted gaps",
    )
    assert FittedDistribution.from_dict({"names": [*NAMES, "attention"], **base.to_dict()}).to_dict() == base.to_dict()
    noisy = join_independent(base, NoiseDistribution(2))
    assert [(each.name, each.share) for each in noisy.strata] == [("unseen", 1.4e-4), ("looked", 1.0 - 1.4e-4)]
    assert [refit.strata[0].share for refit in noisy.refits] == [3e-4, 1e-4]
    x = noisy.strata[1].base.sample(3, np.random.default_rng(0))
    assert noisy.log_prob(x) == pytest.approx(noisy.strata[1].base.log_prob(x) + np.log(1.0 - 1.4e-4))
    assert noisy.noise.tolist() == [False] * 5 + [True] * 2


def test_parameters_of_strata_are_shares_and_those_of_the_parts() -> None:
    both = make_strata()
    listed = both.parameters([*NAMES, "attention"])
    values = [each.value for each in listed]
    assert listed[0].name == "share of unseen" and listed[-1].name == "deceleration accepted behind (looked)"
    x = both.sample(50, np.random.default_rng(0))
    assert both.with_parameters(values).log_prob(x) == pytest.approx(both.log_prob(x))
    values[0], values[-1] = 2.8e-4, 1.0
    changed = both.with_parameters(values)
    assert (changed.strata[0].share, changed.strata[1].base.blocks[0].limit) == (2.8e-4, 1.0)


def test_normals_of_a_file_are_the_same_block_in_all_refits_and_their_ends_have_an_image() -> None:
    base = load_base(find_scenario("rare_envs/CutIn-v1"), "us101-test")
    pool = base.covering_ensemble()
    x = pool.sample(200, np.random.default_rng(0))
    mean = np.mean([np.exp(each.log_prob(x)) for each in base.refits], axis=0)
    assert np.exp(pool.log_prob(x)) == pytest.approx(mean, rel=0.05)  # but for what the box cuts away
    assert pool.blocks[1] is base.refits[0].blocks[1]
    u = CutNormals([-np.inf, LIMIT], [LIMIT, 2.0]).to_standard_normal([[LIMIT, LIMIT], [LIMIT, 2.0]])
    assert np.isfinite(u).all() and (np.abs(u) > 7.0).all()


@pytest.mark.parametrize("env_id", ["rare_envs/CutIn-v1", "rare_envs/HardBrake-v0"])
def test_points_far_out_go_there_and_back_as_finite_numbers(env_id: str) -> None:
    """Searches go there: 2,000 points up to 12 and 38 standard deviations out in each direction."""
    base = load_base(find_scenario(env_id), "us101")
    u = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, base.low.size)) * np.repeat([12.0, 38.0], 1000)[:, None]
    x = base.from_standard_normal(u)
    assert ((x >= base.low) & (x <= base.high)).all()
    assert np.isfinite(base.to_standard_normal(x)).all() and not np.isnan(base.log_prob(x)).any()


def test_the_density_has_a_bound_at_the_corners_of_a_box_that_a_difference_cuts() -> None:
    """A lead that slows keeps 1 m/s or more: at a loss of 44 m/s its speed would have the range from 45 to 45 m/s."""
    for stratum in load_base(find_scenario("hard_brake"), "us101").strata:
        low, high = np.array(stratum.base.low), np.array(stratum.base.high)
        share = np.array(list(itertools.product((0.0, 0.001, 0.01, 0.5, 0.99, 0.999, 1.0), repeat=4)))
        x = low + share * (high - low)
        x[:, 3] = np.clip(x[:, 3], low[3], np.minimum(x[:, 0] - 1.0, high[3]))  # the difference at its end
        assert (
            stratum.base.log_prob(x).max()
            < stratum.base.log_prob(stratum.base.sample(2000, np.random.default_rng(0))).max() + 1.0
        )
    near = np.array([[45.0, 57.0, 4.2, 44.0], [44.999, 57.0, 4.2, 43.999], [44.9, 57.0, 4.2, 43.5]])
    assert np.exp(load_base(find_scenario("hard_brake"), "us101").log_prob(near)).max() < 1e-12
