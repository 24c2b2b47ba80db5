"""Laws of which some coordinates are logarithms, against closed forms and numerical integrals."""

import numpy as np
import pytest
from scipy import integrate, stats

from rare_envs.distributions.log_mixture import LogMixture

LAW = LogMixture.from_dict(
    {
        "weights": [0.6, 0.4],
        "means": [[10.0, 2.5], [14.0, 3.2]],
        "covariances": [[[4.0, 0.5], [0.5, 0.4]], [[2.0, -0.3], [-0.3, 0.2]]],
        "low": [8.0, 3.0],
        "high": [18.0, 40.0],
        "logarithmic": [False, True],
    }
)


def one(low: float, high: float) -> LogMixture:
    """A log-normal law: log x ~ N(2.5, 0.7^2)."""
    row = {"weights": [1.0], "means": [[2.5]], "covariances": [[[0.49]]], "low": [low], "high": [high]}
    return LogMixture.from_dict({**row, "logarithmic": [True]})


def test_one_coordinate_is_scipys_truncated_log_normal() -> None:
    low, high = 5.0, 60.0
    law, reference = one(low, high), stats.lognorm(0.7, scale=np.exp(2.5))
    mass = reference.cdf(high) - reference.cdf(low)
    x = np.linspace(5.01, 59.9, 50)
    np.testing.assert_allclose(law.log_prob(x[:, None]), reference.logpdf(x) - np.log(mass), rtol=1e-12)
    u = stats.norm.ppf((reference.cdf(x) - reference.cdf(low)) / mass)
    np.testing.assert_allclose(law.to_standard_normal(x[:, None])[:, 0], u, atol=1e-10)
    draws = law.sample(20_000, np.random.default_rng(0))[:, 0]
    assert stats.kstest(draws, lambda t: (reference.cdf(t) - reference.cdf(low)) / mass).pvalue > 1e-4


def test_density_integrates_to_one() -> None:
    total, error = integrate.dblquad(
        lambda b, a: float(np.exp(LAW.log_prob(np.array([[a, b]])))[0]), 8.0, 18.0, 3.0, 40.0, epsabs=1e-7
    )
    assert total == pytest.approx(1.0, abs=max(1e-6, error))
    assert (LAW.log_prob(np.array([[9.0, 2.99], [9.0, 40.1], [7.9, 5.0]])) == -np.inf).all()


def test_round_trip_and_box() -> None:
    u = np.random.default_rng(1).standard_normal((20_000, 2))
    x = LAW.from_standard_normal(u)
    assert ((x > LAW.low) & (x < LAW.high)).all()
    assert np.abs(LAW.to_standard_normal(x) - u).max() < 1e-8
    faces = np.array([LAW.low, LAW.high])
    assert np.isfinite(LAW.to_standard_normal(faces)).all()
    assert np.isfinite(LAW.log_prob(faces)).all()


def test_dict_round_trip_and_refusals() -> None:
    assert LogMixture.from_dict(LAW.to_dict()).to_dict() == LAW.to_dict()
    with pytest.raises(ValueError, match="positive where logarithmic"):
        one(0.0, 10.0)
    with pytest.raises(ValueError, match="length 1"):
        LogMixture.from_dict({**LAW.to_dict(), "logarithmic": [True]})
    with pytest.raises(ValueError, match=r"x\[0, 1\] = 50 is outside"):
        LAW.to_standard_normal(np.array([[9.0, 50.0]]))


@pytest.mark.parametrize("flags", ["abc", {"a": 1}, [1, 0], None, True])
def test_logarithmic_has_to_be_a_list_of_booleans(flags: object) -> None:
    with pytest.raises(ValueError, match="list of true and false"):
        LogMixture.from_dict({**LAW.to_dict(), "logarithmic": flags})
