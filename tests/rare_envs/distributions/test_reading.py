"""Entries of base files: kinds of distributions by their keys, records by their fields."""

from typing import Any

import pytest

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.fitted import (
    PredictiveCheck,
    read_distribution,
    read_record,
    require_count,
    require_number,
    require_text,
)
from rare_envs.distributions.mixture import CoordinateMixture, TruncatedGaussianMixture

NORMAL: dict[str, Any] = {"weights": [1.0], "means": [[2.0]], "covariances": [[[1.0]]], "low": [1.0], "high": [9.0]}


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (NORMAL, TruncatedGaussianMixture),
        ({**NORMAL, "logarithmic": [True]}, CoordinateMixture),
        ({**NORMAL, "logarithmic": []}, TruncatedGaussianMixture),
        ({**NORMAL, "coordinates": ["log"]}, CoordinateMixture),
        ({**NORMAL, "names": ["gap"], "order": ["gap"]}, CoordinateMixture),
        ({"alpha": [2.0], "beta": [2.0], "low": [0.0], "high": [1.0]}, BetaDistribution),
    ],
)
def test_keys_tell_the_kind(content: dict[str, Any], kind: type) -> None:
    read = read_distribution(content)
    assert type(read) is kind
    assert type(read_distribution(read.to_dict())) is kind


def test_a_record_has_the_fields_of_its_class() -> None:
    content = {"name": "gap < 3 m", "recorded": 4, "expected": 2.5}
    assert read_record(PredictiveCheck, "a check", content) == PredictiveCheck("gap < 3 m", 4, 2.5)
    for wrong, message in [
        ([1], r"Expected a check as an object with name, recorded, expected, got \[1\]\."),
        ({**content, "found": 3}, r"recorded, expected, got unknown found\."),
        ({"name": "gap < 3 m"}, r"got no recorded, expected\."),
        ({**content, "recorded": -1}, "recorded of a check as a whole number, 0 or more, got -1"),
        ({**content, "expected": -0.5}, r"expected of a check as a number above 0, got -0\.5"),
        ({**content, "name": 3}, "name of a check as a text, got 3"),
    ]:
        with pytest.raises(ValueError, match=message):
            read_record(PredictiveCheck, "a check", wrong)


def test_numbers_within_their_ranges_pass() -> None:
    require_count("count", 1)
    require_count("count", 0, least=0)
    require_number("share", 1, high=1.0)
    require_number("km", 1e-9)
    require_text("source", "a")
    assert PredictiveCheck("gap < 3 m", 0, 0).expected == 0
