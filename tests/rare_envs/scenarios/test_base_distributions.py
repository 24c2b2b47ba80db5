"""Traffic models of scenarios: by name, from a file, as a dictionary or an object, and what does not fit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.stats import kstest

import rare_envs
from rare_envs.control.human_driver import MAX_HUMAN_BRAKING
from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.fitted import FittedDistribution
from rare_envs.distributions.mixture import TruncatedGaussianMixture
from rare_envs.distributions.space import Distribution, ScenarioSpace
from rare_envs.scenarios.base import Scenario, load_base
from rare_envs.scenarios.registry import SCENARIOS, find_scenario
from rare_envs.traffic.bodies import overlaps
from rare_envs.traffic.state import VEHICLE_LENGTH
from tests.rare_envs.scenarios.standing import STANDING

FOLLOWING = find_scenario("car_following")
CUT_IN = find_scenario("cut_in")


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(("scenario", "base"), [(each, base) for each in SCENARIOS.values() for base in each.bases])
def test_shipped_bases_fit_their_scenario(scenario: Scenario, base: str) -> None:
    space = ScenarioSpace(scenario.parameters, load_base(scenario, base))
    assert isinstance(space.base, Distribution)
    x = space.sample(1000, rng())
    assert x.shape == (1000, scenario.size)
    assert (space.validate(x) == x).all()
    assert np.isfinite(space.log_prob(x)).all()
    back = space.from_standard_normal(space.to_standard_normal(x))
    np.testing.assert_allclose(back, x, atol=1e-8)
    if scenario.drivers is None:
        assert min(kstest(column, "norm").pvalue for column in space.to_standard_normal(x).T) > 1e-5
        for width in (3.0, 8.0):  # as wide as draws of two-stage, and more: no weight is 0 for want of support
            far = space.from_standard_normal(width * rng().standard_normal((400, space.dim)))
            assert np.isfinite(space.log_prob(space.validate(far))).all()


@pytest.mark.parametrize(("scenario", "base"), [(each, base) for each in SCENARIOS.values() for base in each.bases])
def test_no_start_is_one_that_cannot_be_on_a_road(scenario: Scenario, base: str) -> None:
    """No bodies overlap, nobody drives backwards, and before a cut-in an ego that brakes fully avoids its own lead."""
    whole: Any = load_base(scenario, base)
    for part in [each.base for each in getattr(whole, "strata", ())] or [whole]:
        state = scenario.initial(torch.from_numpy(part.sample(20_000, rng())))
        assert not overlaps(state, scenario.road, "all").any() and (state.speed >= 0.0).all()
        if scenario.name == "cut_in":
            gap, closing = state.x[:, 2] - state.x[:, 0] - VEHICLE_LENGTH, state.speed[:, 0] - state.speed[:, 2]
            assert (gap >= 1.0 - 1e-9).all()
            assert (closing.clamp_min(0.0).square() / (2.0 * gap) < MAX_HUMAN_BRAKING).all()


def test_a_file_is_read_once_until_it_changes_and_knows_the_bases_of_its_own_scenario(tmp_path: Path) -> None:
    one, again = (load_base(FOLLOWING) for _ in range(2))
    assert isinstance(one, FittedDistribution) and isinstance(again, FittedDistribution)
    assert one.distribution is again.distribution and one.refits == again.refits
    text = FOLLOWING.bases[FOLLOWING.default_base].read_text(encoding="utf-8")
    (tmp_path / "base.json").write_text(text)
    twin = replace(FOLLOWING, bases={"own": tmp_path / "base.json", "other": FOLLOWING.bases["highway"]})
    own = load_base(twin)
    assert isinstance(own, FittedDistribution)
    assert (own.sibling("other").sample(9, rng()) == load_base(FOLLOWING, "highway").sample(9, rng())).all()
    with pytest.raises(ValueError, match="'other'"):
        one.sibling("other")
    (tmp_path / "base.json").write_text(json.dumps({**json.loads(text), "family": "another"}))
    changed = load_base(twin)
    assert isinstance(changed, FittedDistribution) and changed.family == "another"


GAUSSIAN = {"weights": [1.0], "means": [[15.0, 40.0]], "covariances": [[[4.0, 0.0], [0.0, 25.0]]]}
WITH_LOGARITHM = {"weights": [1.0], "means": [[15.0, 3.5]], "covariances": [[[4.0, 0.0], [0.0, 0.0625]]]}


@pytest.mark.parametrize(
    ("content", "kind", "median"),
    [
        (GAUSSIAN, TruncatedGaussianMixture, [15.0, 40.0]),
        ({**WITH_LOGARITHM, "coordinates": ["plain", "log"]}, TruncatedGaussianMixture, [15.0, np.exp(3.5)]),
        ({"alpha": [2.0, 2.0], "beta": [2.0, 2.0]}, BetaDistribution, [17.5, 80.0]),
    ],
)
def test_a_dictionary_has_the_names_and_the_box_of_its_scenario(content: Any, kind: type, median: list[float]) -> None:
    """The box cuts the normals more than 4.7 standard deviations out, which moves the medians by less than 1e-4."""
    base = load_base(replace(STANDING, bases={"mine": content}), "mine")
    assert type(base) is kind
    assert (base.low.tolist(), base.high.tolist()) == ([5.0, 10.0], [30.0, 150.0])
    np.testing.assert_allclose(base.from_standard_normal(np.zeros((1, 2)))[0], median, atol=1e-4)


def shipped_dict(scenario: Scenario = FOLLOWING) -> dict[str, Any]:
    base = load_base(scenario)
    assert isinstance(base, FittedDistribution)
    assert isinstance(base.distribution, TruncatedGaussianMixture)
    return {"names": [p.name for p in scenario.parameters], **base.distribution.to_dict()}


def write(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": ["gap", "ego_speed", "lead_speed"]}, "does not fit car_following: expected names"),
        ({"names": None}, "expected names .* got None"),
        ({"low": [-5.0, 0.0, 1.0]}, r"expected ego_speed within \[0, 45\] m/s, got \[-5, 45\]"),
        ({"weights": [1.0]}, "weights of shape"),
        ({"refits": [{}], "events": {"used": [9], "clusters": 9}, "family": "plain"}, r"got no weights, means, covari"),
    ],
)
def test_json_that_does_not_fit(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = write(tmp_path / "mine.json", {**shipped_dict(), **change})
    with pytest.raises(ValueError, match=message) as caught:
        load_base(FOLLOWING, path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_no_base(tmp_path: Path) -> None:
    broken = tmp_path / "broken.json"
    broken.write_text("{", encoding="utf-8")
    binary = tmp_path / "binary.json"
    binary.write_bytes(b"\xff\xfe\x00")
    for base, message in [
        ("us11", r"'us11' for cut_in \(did you mean 'us101'\?\): neither one of us101,.* nor a"),
        (tmp_path, "nor a file"),
        (broken, "broken.json is not valid JSON"),
        (binary, "Cannot read the traffic model"),
        (write(tmp_path / "list.json", [1]), "expected a JSON object, got list"),
    ]:
        with pytest.raises(ValueError, match=message) as caught:
            load_base(CUT_IN, base)
        assert "\n" not in str(caught.value)


def fitted_dict() -> dict[str, Any]:
    shipped = shipped_dict()
    components = {key: shipped[key] for key in ("weights", "means", "covariances")}
    wider = {**components, "covariances": np.multiply(shipped["covariances"], 1.2).tolist()}
    return {
        **shipped,
        "refits": [components, wider],
        "events": {"used": [470], "clusters": 28},
        "family": "3 components, plain",
    }


def test_a_fitted_file_has_refits_and_knows_the_other_bases(tmp_path: Path) -> None:
    base = load_base(FOLLOWING, write(tmp_path / "mine.json", fitted_dict()))
    assert isinstance(base, FittedDistribution)
    assert base.fitted_to == "470 events of 28 scenes"
    shipped = load_base(FOLLOWING)
    x = shipped.sample(10, rng())
    assert (base.log_prob(x) == shipped.log_prob(x)).all()
    assert (base.refits[0].log_prob(x) == shipped.log_prob(x)).all()
    assert (base.sibling(next(iter(FOLLOWING.bases))).log_prob(x) == shipped.log_prob(x)).all()
    with pytest.raises(ValueError, match=r"No traffic model 'us11' for car_following \(did you mean 'us101'"):
        base.sibling("us11")


def test_a_problem_on_a_fitted_file_has_refits_of_all_its_columns(tmp_path: Path) -> None:
    base = str(write(tmp_path / "mine.json", fitted_dict()))
    with_weather = rare_envs.DrivingProblem("rare_envs/CarFollowing-v0", base=base, weather=True)
    assert isinstance(with_weather.base, FittedDistribution)
    x = with_weather.base.sample(5, rng())
    for refit in with_weather.base.refits:
        assert np.isfinite(refit.log_prob(x)).all()


class Draws:
    """Draws of one's own."""

    def __init__(self, draws: NDArray[np.float64]) -> None:
        self.draws = draws

    def sample(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return np.resize(self.draws, (n, self.draws.shape[1]))


class Complete(Draws):
    def log_prob(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.zeros(len(x))

    to_standard_normal = from_standard_normal = log_prob


@pytest.mark.parametrize(
    ("base", "message"),
    [
        (3, "A traffic model must be one of us101, .*, a path .*; got int without sample, log_prob, to_stand"),
        (Draws(np.zeros((1, 3))), r"; got Draws without log_prob, to_standard_normal, from_standard_normal\.$"),
        (Complete(np.zeros((1, 6))), r"shape \(1000, 3\), one column for each of ego_.*, gap; got \(1000, 6\)\.$"),
        (Complete(np.array([[20.0, 45.1, 30.0]])), r"not fit car_following: it draws lead_speed outside \[0, 45\] m/s"),
        (Complete(np.array([[20.0, 10.0, np.nan]])), r"it draws gap outside \[1, 150\] m; truncate it\.$"),
    ],
)
def test_an_object_that_does_not_fit_is_refused(base: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_base(FOLLOWING, base)
