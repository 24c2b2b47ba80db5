"""Auto: the choice of a method by budget, dimension, terms and cost per simulation; the default."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from samplers.method import Choice, Goal, Steps, offer_of
from samplers.methods.base import Method
from samplers.methods.searched import noise_mask
from samplers.methods.surrogate import Surrogate
from samplers.methods.two_stage.method import TwoStage, suits_terms
from samplers.problem import Inputs
from samplers.validation import check_setting

FEW = (300, 500)
"""Simulations of a run, from and to, for `Surrogate`. It was measured from 300 on
(`benchmarks/results/few_simulations.json`). With 1,000 its intervals hold p in 68 and 82 % of 40 runs on the cut-ins
(`benchmarks/results/against_truth.json`), where those of `TwoStage` hold it in 24 of 24 with 600 and with 1,000."""
MOST_DIMS = 6
"""Dimensions up to which `Surrogate` was measured (`benchmarks/estimators/few_simulations`)."""
SLOW = 1.0
"""Seconds of a simulation from which on 6,000 of them are taken as too many where max_sim does not say: 100 minutes."""
SLOW_BUDGET = 1000
"""Simulations that are planned for then."""


@dataclass(frozen=True, kw_only=True)
class Auto(Method):
    """Choice between the two methods for all problems, by a rule that looks at no outcome; the default of `estimate`.

    1. *Budget and dimension.* `Surrogate` where a run has 300 to 500 simulations and the search at most 6 dimensions
       (coordinates that the base distribution calls noise are not searched), `TwoStage` otherwise.
    2. *Terms.* `TwoStage` searches by terms with 30 coordinates or more, 1,000 simulations or more, and a problem that
       offers terms and their gradients.
    3. *Cost.* Without max_sim a run has the 6,000 simulations of `TwoStage`, or, if one takes a second or more, 1,000;
       a target c.o.v. without max_sim goes to `TwoStage`.

    The budget is that of one replicate. The result is that of the method chosen, to the bit, and names it;
    `Estimate.choice` says which and why, and so does the result's text where it is not `TwoStage`.

    Args:
        seconds_per_simulation: Time that one simulation takes; None where it is not known.

    Example:
        >>> import samplers
        >>> problem = samplers.FunctionProblem(lambda u: 3.5 - u[:, 0], dim=2)
        >>> for max_sim in (300, 3000):
        ...     print(samplers.estimate(problem, "auto", seed=0, max_sim=max_sim).choice)
        surrogate: 300 simulations for 2 dimensions
        two-stage: 3,000 simulations for 2 dimensions
    """

    seconds_per_simulation: float | None = None

    name: ClassVar[str] = "auto"
    stops_at_target: ClassVar[bool] = True

    def __post_init__(self) -> None:
        """Check the settings."""
        if self.seconds_per_simulation is not None:
            check_setting("Auto", "seconds_per_simulation", self.seconds_per_simulation, 0.0, math.inf)

    def choose(self, inputs: Inputs, goal: Goal) -> Choice:
        """Return the method for one run, with the budget and the target of one replicate."""
        noise = noise_mask(inputs)
        dim = inputs.dim - (0 if noise.all() else int(np.count_nonzero(noise)))
        slow = (self.seconds_per_simulation or 0.0) >= SLOW and goal.target_cov is None
        usual = SLOW_BUDGET if slow else TwoStage().n
        budget = usual if goal.max_sim is None else goal.max_sim
        by_terms = suits_terms(inputs, offer_of(inputs), budget)
        few = FEW[0] <= budget <= FEW[1] and dim <= MOST_DIMS
        method = Surrogate() if few else TwoStage()
        how = method.name + " by terms" * by_terms
        return Choice(method, f"{how}: {budget:,} simulations for {dim:,} dimension{'s' * (dim != 1)}", unusual=few)

    def steps(self, inputs: Inputs, goal: Goal, rng: np.random.Generator) -> Steps:
        """Take the steps of the method chosen."""
        return self.choose(inputs, goal).method.steps(inputs, goal, rng)
