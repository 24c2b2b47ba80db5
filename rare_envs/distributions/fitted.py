"""Distributions fitted to recorded events, with what says how far to trust them: refits, counts, checks, frequency."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rare_envs.distributions.beta import BetaDistribution
from rare_envs.distributions.coordinates import FloatArray
from rare_envs.distributions.events import EventCounts, EventFrequency, PredictiveCheck, read_record, require_text
from rare_envs.distributions.mixture import (
    COMPONENT_FIELDS,
    TruncatedGaussianMixture,
    name_kinds,
    pool_mixtures,
)
from rare_envs.distributions.product import ProductDistribution, box_of
from rare_envs.distributions.space import Distribution, DistributionParameter
from rare_envs.distributions.stratified import CutNormals, StratifiedDistribution, Stratum, read_part, write_part

FileDistribution = TruncatedGaussianMixture | BetaDistribution | ProductDistribution | StratifiedDistribution
FITTED_KEYS = ("refits", "events", "family", "frequency", "checks")
"""Keys of a base file of which each makes it a fitted one; these then need `events` and `family`."""
BETA_SHAPES = ("alpha", "beta")
MAX_COVERING_REFITS = 30
"""Refits whose mixture reaches where failures under any of them lie: of 100, more take longer and reach no further."""
PART_KEYS = ("share", "accepted")
"""Keys of a stratum that a refit has of its own."""


def read_distribution(data: Mapping[str, Any]) -> FileDistribution:
    """Return the distribution of the kind that the keys of a file tell: strata, Beta variables, or a mixture."""
    if "strata" in data:
        return StratifiedDistribution.from_dict(data)
    return BetaDistribution.from_dict(data) if "alpha" in data else cast(FileDistribution, read_part(data))


@dataclass(frozen=True, eq=False, kw_only=True)
class FittedDistribution:
    """A traffic model fitted to events, with refits to resampled events: how far the events determine it.

    Density, sampling and maps are those of `distribution`.

    Raises:
        ValueError: A refit has no four methods, other dimensions or another box.

    Example:
        >>> fit, refit = (TruncatedGaussianMixture([1.0], [[m]], [[[1.0]]], [-9.0], [9.0]) for m in (0.0, 0.3))
        >>> base = FittedDistribution(
        ...     distribution=fit, refits=(fit, refit), events=EventCounts(used=(40,), clusters=12), family="1 component"
        ... )
        >>> base.fitted_to, base.ensemble().weights.tolist()
        ('40 events of 12 scenes', [0.5, 0.5])
    """

    distribution: Distribution
    """The fit."""
    refits: tuple[Distribution, ...] = ()
    """The same recipe applied to resampled events, of the same parameters and box; none if nobody made them."""
    events: EventCounts
    """What it was fitted to."""
    family: str
    """Family of distributions in words, such as "1 component, log gaps"."""
    frequency: EventFrequency | None = None
    """How often the events happen; None if nobody counted."""
    checks: tuple[PredictiveCheck, ...] = ()
    """Recorded against expected counts."""
    record: Mapping[str, Any] = field(default_factory=dict)
    """Provenance: sources, licence, site, date, coordinates, criteria of the selection; `provenance` of a file."""
    siblings: Callable[[str], Distribution] | None = field(default=None, repr=False)
    """Loader of other traffic models of the same scenario, by name or file."""
    fitted_to: str = field(init=False, repr=False)
    """The events in words, such as "38 + 15 events of 17 scenes"."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "fitted_to", self.events.describe())
        object.__setattr__(self, "refits", tuple(self.refits))
        object.__setattr__(self, "checks", tuple(self.checks))
        require_text("family", self.family)
        if not isinstance(self.record, Mapping):
            raise ValueError(f"Expected provenance as an object, got {self.record!r}.")
        for i, refit in enumerate(self.refits):
            if not isinstance(refit, Distribution):
                raise ValueError(
                    f"Expected refits[{i}] with the four methods of a distribution, got {type(refit).__name__}."
                )
            for name in ("dim", "low", "high"):
                own, expected = (getattr(each, name, None) for each in (refit, self.distribution))
                if own is not None and expected is not None and not np.array_equal(own, expected):
                    raise ValueError(f"Expected refits[{i}] with {name} {expected} as its base, got {own}.")

    @property
    def dim(self) -> int:
        """Number of columns d."""
        return int(cast(Any, self.distribution).dim)

    @property
    def low(self) -> FloatArray:
        """Lower bounds of the box, shape (d,)."""
        return cast(FloatArray, cast(Any, self.distribution).low)

    @property
    def high(self) -> FloatArray:
        """Upper bounds of the box, shape (d,)."""
        return cast(FloatArray, cast(Any, self.distribution).high)

    @property
    def blocks(self) -> tuple[Any, ...]:
        """Independent distributions side by side; none if it has only one."""
        return getattr(self.distribution, "blocks", ())

    @property
    def strata(self) -> tuple[Stratum, ...]:
        """Parts of the population with shares of their own, none if it has none; those of a refit are its own."""
        return getattr(self.distribution, "strata", ())

    @property
    def noise(self) -> NDArray[np.bool_]:
        """Mask of the columns that are noise, shape (d,): samplers may leave these as they are."""
        return cast(NDArray[np.bool_], getattr(self.distribution, "noise", np.zeros(self.dim, dtype=bool)))

    @property
    def clusters(self) -> int:
        """Number of independent clusters of events."""
        return self.events.clusters

    @property
    def refit_families(self) -> tuple[int, ...]:
        """Number of the coordinates of each refit, equal ones have the same; 0 are those of `distribution`."""
        names = [tuple(map(name_kinds, getattr(each, "blocks", (each,)))) for each in (self.distribution, *self.refits)]
        numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
        return tuple(numbers[name] for name in names[1:])

    def sample(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw independent points, shape (n, d)."""
        return self.distribution.sample(n, rng)

    def log_prob(self, x: FloatArray) -> FloatArray:
        """Return the log density, (n, d) -> (n,)."""
        return self.distribution.log_prob(x)

    def to_standard_normal(self, x: FloatArray) -> FloatArray:
        """Map to standard normal space, (n, d) -> (n, d)."""
        return self.distribution.to_standard_normal(x)

    def from_standard_normal(self, u: FloatArray) -> FloatArray:
        """Map from standard normal space, (n, d) -> (n, d)."""
        return self.distribution.from_standard_normal(u)

    def parameters(self, names: Sequence[str] = (), like: object = None) -> tuple[DistributionParameter, ...]:
        """Return the parameters of `distribution`, none if it offers none; see `DistributionParameter`."""
        own: Any = self.distribution
        return own.parameters(names, like) if hasattr(own, "parameters") else ()

    def with_parameters(self, values: ArrayLike) -> Distribution:
        """Return `distribution` with other values of its parameters.

        Raises:
            ValueError: It has no parameters, or not so many.
        """
        own: Any = self.distribution
        if not hasattr(own, "with_parameters"):
            raise ValueError(f"A {type(own).__name__} has no parameters.")
        return cast(Distribution, own.with_parameters(values))

    def ensemble(self) -> Distribution:
        """Return the refits as one mixture with equal weights: what they predict for the next event.

        Mixtures of the same coordinates are cut to the box as a whole, see `pool_mixtures`; blocks that all refits
        share stay as they are. Refits made of strata are not mixed: their shares are.

        Raises:
            ValueError: There are no refits, or they are no mixtures.
        """
        if not self.refits:
            raise ValueError("There are no refits to make an ensemble of.")
        return _pool(self.refits)

    def covering_ensemble(self) -> Distribution:
        """Return the mixture of at most 30 of the refits, evenly chosen: to simulate failures under any of them.

        Its map takes a third of the time of that of a hundred refits, and its failures are worth as much under these.

        Raises:
            ValueError: As `ensemble`.
        """
        last = len(self.refits) - 1
        chosen = np.linspace(0, last, min(MAX_COVERING_REFITS, last + 1)).round().astype(int)
        return replace(self, refits=tuple(self.refits[i] for i in chosen)).ensemble()

    def sibling(self, name: str) -> Distribution:
        """Return another traffic model of the same scenario, by name or file.

        Raises:
            ValueError: There is no such one, or this distribution was made by hand and knows none.
        """
        if self.siblings is None:
            raise ValueError(f"This traffic model was not loaded by name and knows no {name!r}; give an object.")
        return self.siblings(name)

    def to_dict(self) -> dict[str, Any]:
        """Return the entries of a base file, from which `from_dict` makes the same distribution.

        Raises:
            ValueError: The distribution or a refit is not of a kind that files hold, or a refit differs in its box.
        """
        own = _to_dict(self.distribution)
        return {
            **own,
            "family": self.family,
            "events": {**asdict(self.events), "used": list(self.events.used)},
            "frequency": None if self.frequency is None else asdict(self.frequency),
            "checks": [asdict(check) for check in self.checks],
            "provenance": dict(self.record),
            "refits": [_refit_entries(i, refit, own) for i, refit in enumerate(self.refits)],
        }

    @classmethod
    def from_dict(
        cls, data: Mapping[str, Any], siblings: Callable[[str], Distribution] | None = None
    ) -> FittedDistribution:
        """Return the distribution that `to_dict` describes; other keys are left alone.

        Args:
            data: Keys of the distribution (see `TruncatedGaussianMixture.from_dict`), and `events`, `family`, and if
                wanted `refits`, `frequency`, `checks` and `provenance`. A refit is an object with weights, means and
                covariances (alpha and beta, if the base has these), in the coordinates of the base or with
                `coordinates` and `order` of its own.
            siblings: Loader of other traffic models of the same scenario.

        Raises:
            ValueError: A key is missing or its value is not valid.
        """
        missing = [name for name in ("events", "family") if name not in data]
        if missing:
            raise ValueError(
                f"A file with {', '.join(k for k in FITTED_KEYS if k in data)} lacks {', '.join(missing)}."
            )
        lists = {key: data.get(key, ()) for key in ("refits", "checks")}
        for key, values in lists.items():
            if not isinstance(values, list | tuple):
                raise ValueError(f"Expected {key} as a list of objects, got {values!r}.")
        frequency = data.get("frequency")
        return cls(
            distribution=read_distribution(data),
            refits=tuple(_read_refit(i, refit, data) for i, refit in enumerate(lists["refits"])),
            events=read_record(EventCounts, "events", data["events"]),
            family=data["family"],
            frequency=None if frequency is None else read_record(EventFrequency, "frequency", frequency),
            checks=tuple(read_record(PredictiveCheck, "a check", each) for each in lists["checks"]),
            record=data.get("provenance", {}),
            siblings=siblings,
        )


def _pool(refits: Sequence[Any]) -> Distribution:
    """Return refits as one distribution; of products, blocks that are the same in all stay as they are."""
    if not all(isinstance(each, ProductDistribution) for each in refits):
        return pool_mixtures(refits)
    columns = zip(*(each.blocks for each in refits), strict=True)
    return ProductDistribution(
        tuple(own[0] if all(_is_same(block, own[0]) for block in own) else _pool(own) for own in columns)
    )


def _is_same(block: Any, other: Any) -> bool:
    """Return whether blocks are one distribution: the same object, or normals with the same ends."""
    both = isinstance(block, CutNormals) and isinstance(other, CutNormals)
    return block is other or (both and all(map(np.array_equal, box_of(block), box_of(other))))


def join_independent(*distributions: Distribution) -> Distribution:
    """Return independent distributions side by side as one; their own blocks, if they have some, become its blocks.

    If exactly one of them is fitted to events, so is the whole: its refits have the other blocks as they are, and
    events, frequency, checks and record are those of the fitted one. With several fitted ones it is not: their refits
    do not belong together.

    Example:
        >>> from rare_envs.distributions import NoiseDistribution
        >>> join_independent(NoiseDistribution(3), NoiseDistribution(2)).dim
        5
    """
    if len(distributions) == 1:
        return distributions[0]
    fitted = [each for each in distributions if isinstance(each, FittedDistribution)]
    blocks: list[Any] = []
    for each in distributions:
        plain = each.distribution if isinstance(each, FittedDistribution) else each
        blocks += getattr(plain, "blocks", (plain,))
    whole = ProductDistribution(tuple(blocks))
    if len(fitted) != 1:
        return whole
    join_with = partial(_join_with, distributions)
    return replace(
        fitted[0],
        distribution=whole,
        refits=tuple(map(join_with, fitted[0].refits)),
        siblings=partial(_join_sibling, distributions, fitted[0]),
    )


def _join_with(distributions: Sequence[Distribution], replacement: Distribution) -> Distribution:
    """Return distributions as one with another in place of the fitted one."""
    return join_independent(*(replacement if isinstance(each, FittedDistribution) else each for each in distributions))


def _join_sibling(distributions: Sequence[Distribution], fitted: FittedDistribution, name: str) -> Distribution:
    """Return distributions as one with another traffic model in place of the fitted one."""
    return _join_with(distributions, fitted.sibling(name))


def _read_refit(i: int, refit: object, data: Mapping[str, Any]) -> FileDistribution:
    """Return a refit, whose entries replace those of the base, or stratum by stratum those of its strata."""
    if "strata" not in data:
        merged = _merge(f"refits[{i}]", refit, data)
    else:
        parts, own = data["strata"], refit.get("strata") if isinstance(refit, Mapping) else None
        if not isinstance(own, list | tuple) or len(own) != len(parts):
            raise ValueError(f"Expected refits[{i}] with strata, one for each of its base, got {refit!r}.")
        strata = [_merge(f"refits[{i}], {part['name']}", each, part) for each, part in zip(own, parts, strict=True)]
        merged = {**data, "strata": strata}
    try:
        return read_distribution(merged)
    except ValueError as error:
        raise ValueError(f"refits[{i}]: {error}") from None


def _merge(what: str, refit: object, base: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a refit, or of a stratum of one, with those of the base for what it does not have."""
    wanted = BETA_SHAPES if "alpha" in base else COMPONENT_FIELDS
    if not isinstance(refit, Mapping):
        raise ValueError(f"Expected {what} as an object with {', '.join(wanted)}, got {refit!r}.")
    if missing := [name for name in wanted if name not in refit]:
        raise ValueError(f"Expected {what} with {', '.join(wanted)}, got no {', '.join(missing)}.")
    # Coordinates of its own come with an order of their own, or that of x.
    return {**{k: v for k, v in base.items() if "coordinates" not in refit or k != "order"}, **refit}


def _to_dict(distribution: Distribution) -> dict[str, Any]:
    """Return the entries of a distribution of a kind that files hold."""
    if isinstance(distribution, StratifiedDistribution | BetaDistribution):
        return distribution.to_dict()
    return write_part(distribution)


def _refit_entries(i: int, refit: Distribution, base: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a refit that are its own, or those of each of its strata."""
    entries = _to_dict(refit)
    if {"alpha", "strata"} & {*entries} != {"alpha", "strata"} & {*base}:
        raise ValueError(f"refits[{i}] is of another kind than its base; a file holds one for all.")
    if "strata" in base:
        return {"strata": [_own_entries(*pair) for pair in zip(entries["strata"], base["strata"], strict=True)]}
    return _own_entries(entries, base)


def _own_entries(entries: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    """Return the entries of a refit, or of a stratum of one, that are its own."""
    kept = BETA_SHAPES if "alpha" in base else (*COMPONENT_FIELDS, *(key for key in PART_KEYS if key in base))
    own = {name: entries[name] for name in kept}
    usual = {"coordinates": ["plain"] * len(entries["low"]), "order": []}  # as they are where not written
    theirs, ours = ({key: each.get(key, usual[key]) for key in usual} for each in (entries, base))
    return own if theirs == ours else own | theirs
