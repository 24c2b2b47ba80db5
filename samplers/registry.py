"""The methods by the names that the command line uses."""

import difflib
import inspect
from typing import Any

from samplers.cross_entropy import CrossEntropy
from samplers.method import Method
from samplers.monte_carlo import MonteCarlo
from samplers.subset import AdaptiveSubsetSimulation

METHODS: dict[str, type[Method]] = {
    method.name: method for method in (MonteCarlo, CrossEntropy, AdaptiveSubsetSimulation)
}


def get_method(name: str, **settings: Any) -> Method:
    """Return the method of that name with the given settings.

    Raises:
        ValueError: If the name or a setting is not known (the nearest one is suggested) or a
            setting has a value out of range.
    """
    check_name("method", name, list(METHODS))
    cls = METHODS[name]
    for setting in settings:
        check_name(f"setting of {cls.__name__}", setting, list(inspect.signature(cls).parameters))
    return cls(**settings)


def check_name(kind: str, name: object, valid: list[str]) -> None:
    """Raise a ValueError that suggests the nearest valid name unless `name` is one."""
    if isinstance(name, str) and name in valid:
        return
    near = difflib.get_close_matches(str(name), valid, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    raise ValueError(f"Unknown {kind} {name!r}.{hint} Valid: {', '.join(valid)}.")
