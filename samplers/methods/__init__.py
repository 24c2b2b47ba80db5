"""Methods, by the names that the command line uses, those of other packages included."""

import inspect
import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast

from samplers.method import Stepping
from samplers.methods.auto import Auto
from samplers.methods.cross_entropy import CrossEntropy
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.methods.surrogate import Surrogate
from samplers.methods.two_stage.method import TwoStage
from samplers.output import register_stored
from samplers.validation import check_name

ENTRY_POINT_GROUP = "rare_envs.samplers"
"""Entry points of this group name methods of other packages."""


class Methods(Mapping[str, type[Stepping]]):
    """Methods by name: our own, then those that installed packages offer.

    A package offers a method by an entry point, here in its `pyproject.toml`:

        [project.entry-points."rare_envs.samplers"]
        lattice = "their_package:Lattice"

    with the `name` of the class on the left. Other packages are imported when a name that is not ours, or the list of
    all names, is first requested. An entry point that cannot be used is left out with a `RuntimeWarning` that names it.
    """

    def __init__(self, *own: type[Stepping]) -> None:
        self._own = {method.name: method for method in own}

    @property
    def own(self) -> list[str]:
        """The names of our own methods."""
        return list(self._own)

    @cached_property
    def _installed(self) -> dict[str, type[Stepping]]:
        """Methods of other packages by name."""
        loaded: dict[str, type[Stepping]] = {}
        for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda entry: entry.name):
            try:
                if entry.name in self._own or entry.name in loaded:
                    raise ValueError("that name is taken")
                loaded[entry.name] = _load_method(entry)
            except Exception as error:  # an error of another package must not break this one
                package = "" if entry.dist is None else f" of {entry.dist.name}"
                what = f"The method {entry.name!r}{package} ({entry.value}) cannot be used"
                warnings.warn(f"{what}: {type(error).__name__}: {error}", RuntimeWarning, stacklevel=2)
        return loaded

    def __getitem__(self, name: str) -> type[Stepping]:
        return self._own[name] if name in self._own else self._installed[name]

    def __iter__(self) -> Iterator[str]:
        return iter([*self._own, *self._installed])

    def __len__(self) -> int:
        return len(self._own) + len(self._installed)


METHODS = Methods(
    Auto,
    TwoStage,
    Surrogate,
    MonteCarlo,
    ImportanceSampling,
    CrossEntropy,
    ImprovedCrossEntropy,
    SubsetSimulation,
    AdaptiveSubsetSimulation,
)
register_stored(*(METHODS[name] for name in METHODS.own))


def get_method(name: str, **settings: Any) -> Stepping:
    """Return the method of that name with the given settings.

    Raises:
        ValueError: If the name or a setting is not known (the nearest one is suggested) or a
            setting has a value out of range.

    Example:
        >>> import samplers
        >>> samplers.get_method("mc", n=5000)
        MonteCarlo(n=5000, batch=10000)
    """
    if not isinstance(name, str) or name not in METHODS:
        check_name("method", name, list(METHODS))
    cls = METHODS[name]
    for setting in settings:
        check_name(f"setting of {cls.__name__}", setting, list(inspect.signature(cls).parameters))
    return cls(**settings)


def _load_method(entry: EntryPoint) -> type[Stepping]:
    """Import the class that an entry point names."""
    loaded: object = entry.load()
    if not isinstance(loaded, type):
        raise TypeError(f"expected a class, got {loaded!r}")
    # another package's class: the message says which it lacks
    missing = [name for name in ("name", "stops_at_target", "steps") if not hasattr(loaded, name)]
    if missing:
        raise TypeError(f"the class {loaded.__name__} has no {', '.join(missing)}")
    cls = cast(type[Stepping], loaded)
    if cls.name != entry.name:
        raise ValueError(f"the class {cls.__name__} is named {cls.name!r}, its entry point {entry.name!r}")
    return cls
