"""Methods by the names that the command line uses, and the choice of one, `Auto`."""

import inspect
from dataclasses import dataclass, replace
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any, ClassVar, cast

import numpy as np

from samplers.mcmc import RootedPoints
from samplers.method import Choice, Goal, Interrupted, Outcome, Part, Stepping, Steps, offer_of
from samplers.methods.base import Method, noise_mask
from samplers.methods.cross_entropy import CrossEntropy
from samplers.methods.importance_sampling import ImportanceSampling
from samplers.methods.improved_cross_entropy import ImprovedCrossEntropy
from samplers.methods.kriging import MANY_DIMS
from samplers.methods.monte_carlo import MonteCarlo
from samplers.methods.series.method import Series
from samplers.methods.subset import AdaptiveSubsetSimulation, SubsetSimulation
from samplers.methods.surrogate import Surrogate, SurrogateRun
from samplers.methods.two_stage.method import TwoStage
from samplers.output import register_stored
from samplers.problem import Inputs, check_name
from samplers.sample import Level, Sample, Status

__all__ = [
    "METHODS",
    "Goal",
    "Interrupted",
    "Level",
    "Method",
    "Outcome",
    "Part",
    "Sample",
    "Status",
    "Stepping",
    "Steps",
    "get_method",
]

FEW = 1000
"""Simulations up to which f is first learned by kriging; with more, `TwoStage` has the room for a search of its own."""
SHORT = 2000
"""Simulations up to which `AdaptiveSubsetSimulation` is better than `TwoStage` in many dimensions, where gradients and
rounds take what the search leaves: with 1,500 in 21 to 500 (16 limit states, 6 runs) 2 of 96 runs were off by more than
4 of their standard errors for 27, at half the mean square error; with 3,000 the variance was 8 times as large."""
ENOUGH = 1000
"""Simulations from which `Series` has room for walks, rounds and an estimate."""


@dataclass(frozen=True, kw_only=True)
class Auto(Method):
    """Choice among the methods by budget, dimension and what f does; the default of `estimate`.

    1. *Terms.* `Series` if the problem offers terms and their gradients, with 30 coordinates or more and 1,000
       simulations or more.
    2. *Up to 1,000 simulations* a run begins as `Surrogate`. Its batches are predicted before they are simulated:

       - In up to 20 dimensions it ends so, unless 600 simulations are left when 200 were spent and the failures of two
         batches were never foreseen (f jumps, or fails in many regions): `TwoStage` has the rest.
       - In more it ends so if kriging explains 40 % of the variance of f from 100 base draws (a third of the run, if
         that is less), each that is safe predicted from the others. Else `AdaptiveSubsetSimulation` goes on from these.

       More simulations are for `TwoStage`, but up to 2,000 in more than 20 dimensions for `AdaptiveSubsetSimulation`.
    3. Without max_sim a run has the 6,000 simulations of `TwoStage`, or those that a target c.o.v. takes.

    The budget is that of one replicate; coordinates that the base distribution calls noise are not searched, and do not
    count as dimensions. What decided between methods does not count in p, but for the draws from which subset
    simulation goes on: the safe ones decided, not how many fail. The result names the method, and `Estimate.choice`
    says why. In a sum over strata every run of a stratum chooses for itself, after a pilot of plain draws;
    `Part.method` names all.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - u[:, 0], dim=2)
        >>> for max_sim in (200, 3000):
        ...     print(samplers.estimate(problem, "auto", seed=0, max_sim=max_sim).choice)
        surrogate: 200 simulations for 2 dimensions, failures foreseen
        two-stage: 3,000 simulations for 2 dimensions
    """

    name: ClassVar[str] = "auto"
    stops_at_target: ClassVar[bool] = True
    chooses: ClassVar[bool] = True

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Learn f if there are few simulations, and go on by the method that suits it."""
        budget = TwoStage().n if goal.max_sim is None else goal.max_sim
        noise, offer = noise_mask(inputs), offer_of(inputs)
        dim = inputs.dim - (0 if noise.all() else int(np.count_nonzero(noise)))
        size = f"{budget:,} simulations for {dim:,} dimension{'s' * (dim != 1)}"
        # with fewer coordinates `TwoStage` misses as little
        if offer is not None and offer.gradient_cost is not None and inputs.dim >= 30 and budget >= ENOUGH:
            outcome = yield from Series().steps(inputs, goal, rng)
            return replace(outcome, chosen=Choice(Series(), f"series: {size} and terms", unusual=True))
        if budget > FEW:
            searching = TwoStage() if budget > SHORT or dim <= MANY_DIMS else AdaptiveSubsetSimulation()
            outcome = yield from searching.steps(inputs, goal, rng)
            return replace(outcome, chosen=Choice(searching, f"{searching.name}: {size}"))
        run = SurrogateRun(inputs, goal, budget, rng, may_leave=True)
        found = yield from run.steps()
        if found is not None:
            how = ", failures foreseen" if run.learned else ""
            return replace(found, chosen=Choice(Surrogate(), f"surrogate: {size}{how}", unusual=True))
        left = budget - len(run.f)
        rest, why, method = replace(goal, max_sim=left), "failures were not foreseen", cast(Any, TwoStage())
        about = [inputs, rest, rng]
        if run.many:  # all simulations so far are base draws
            about.append(RootedPoints(run.u, run.f, np.arange(run.n_base)) if run.inputs is inputs else None)
            method, why = AdaptiveSubsetSimulation(), f"kriging explains {max(100 * run.skill, 0):.0f} % of f"
        choice = Choice(method, f"{method.name}: {size}, {why}; {left:,} simulations were left", unusual=True)
        return replace((yield from run.go_on(method.steps(*about))), chosen=choice)


_OWN: tuple[type[Stepping], ...] = (
    *(Auto, TwoStage, Series, Surrogate, MonteCarlo, ImportanceSampling, CrossEntropy, ImprovedCrossEntropy),
    *(SubsetSimulation, AdaptiveSubsetSimulation),
)
METHODS = MappingProxyType({method.name: method for method in _OWN})
"""Methods by name; one of another package is named by its place, "module:Class"."""
register_stored(*_OWN)


def get_method(name: str, **settings: Any) -> Stepping:
    """Return the method of that name with the given settings.

    Args:
        name: One of `METHODS`, or "module:Class" for a class of your own with the protocol of `Method`, or
            "module:object" for an object of one, which has its settings.
        **settings: Fields of the class; those left out have its defaults, or what the object has.

    Raises:
        ValueError: If the name or a setting is not known (the nearest one is suggested), a setting has a value out of
            range, or there is no method in that place.

    Example:
        >>> import samplers
        >>> samplers.methods.get_method("mc", n=5000)
        MonteCarlo(n=5000, batch=10000)
        >>> samplers.methods.get_method("samplers.methods.cross_entropy:CrossEntropy", n_final=500).n_final
        500
    """
    if not isinstance(name, str) or (":" not in name and name not in METHODS):
        check_name("method", name, [*METHODS, "module:Class"])
    found: Any = METHODS[name] if ":" not in name else None
    try:
        found = found or resolve_name(name)
        found = found if isinstance(found, Stepping) and not isinstance(found, type) else _check_class(found)
    except Exception as error:  # the module is the user's: anything may happen in it
        raise ValueError(f"Cannot use the method {name!r}: {_describe(error)}.") from error
    cls = found if isinstance(found, type) else type(found)
    for setting in settings:
        check_name(f"setting of {cls.__name__}", setting, list(inspect.signature(cls).parameters))
    if not isinstance(found, type):
        return cast(Stepping, replace(found, **settings) if settings else found)
    try:
        return cast(Stepping, cls(**settings))
    except ValueError:
        raise
    except Exception as error:  # of a user's class
        hint = f"if it needs settings, name an object that has them, as tuned = {cls.__name__}(...) in its module"
        raise ValueError(f"Cannot make the method {name!r}: {_describe(error)}; {hint}.") from error


def _describe(error: Exception) -> str:
    """Return an error of a user's module in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split()).rstrip('.')}"


def _check_class(cls: Any) -> type[Stepping]:
    """Return what a user says is a method; raise a TypeError that says what it lacks unless it is the class of one."""
    if not isinstance(cls, type):
        raise TypeError(f"expected a class, got {cls!r}")
    missing = [name for name in ("name", "stops_at_target", "steps") if not hasattr(cls, name)]
    if missing:
        raise TypeError(f"the class {cls.__name__} has no {', '.join(missing)}")
    return cast(type[Stepping], cls)
