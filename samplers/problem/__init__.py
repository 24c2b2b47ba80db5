"""Problem: the probability P[f(X) <= gamma] of a function f and a base distribution of X; small f is dangerous."""

from samplers.problem.function_problem import LOG_TWO_PI, FunctionProblem, StandardNormal
from samplers.problem.protocols import (
    ConditionalProblem,
    Distribution,
    FloatArray,
    HasNoise,
    HasTermGradients,
    HasTerms,
    Inputs,
    NamedProblem,
    Problem,
    TermGradients,
    Terms,
    condition_of,
    names_of_columns,
    offers_terms,
)

__all__ = [
    "LOG_TWO_PI",
    "ConditionalProblem",
    "Distribution",
    "FloatArray",
    "FunctionProblem",
    "HasNoise",
    "HasTermGradients",
    "HasTerms",
    "Inputs",
    "NamedProblem",
    "Problem",
    "StandardNormal",
    "TermGradients",
    "Terms",
    "condition_of",
    "names_of_columns",
    "offers_terms",
]
