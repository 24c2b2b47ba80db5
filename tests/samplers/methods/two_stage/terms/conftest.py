"""Shared by the tests of the search by terms: series systems of half-spaces with exact p."""

import numpy as np
import pytest
from scipy.stats import norm

import samplers
from samplers.execution.responder import Responder
from samplers.method import TermsOffer
from samplers.methods.two_stage.terms.space import TermSimulator


def make_half_spaces(dim, p, shares=(0.8, 0.15, 0.05), scale=None, seed=0, **options):
    """Return a problem that fails beyond any of some orthogonal planes, its exact p and the normals (J, d).

    Args:
        dim: Number of dimensions.
        p: About the probability.
        shares: Of the planes in it.
        scale: Factor of each term.
        seed: Of the normals.
        options: Of FunctionProblem.
    """
    normals = np.linalg.qr(np.random.default_rng(seed).standard_normal((dim, len(shares))))[0].T
    beta, scale = -norm.ppf(np.array(shares) * p), np.ones(len(shares)) if scale is None else np.array(scale)

    def gradient(x, term):
        return -normals[term] * scale[term][:, None]

    options = {"gradient": gradient, **options}
    problem = samplers.FunctionProblem(dim=dim, terms=lambda x: (beta - x @ normals.T) * scale, **options)
    return problem, float(1 - np.prod(norm.cdf(beta))), normals


@pytest.fixture
def half_spaces():
    return make_half_spaces


@pytest.fixture
def simulator_of():
    def simulator(problem):
        return TermSimulator(problem, TermsOffer(problem.gradient_cost))

    return simulator


@pytest.fixture
def answer():
    """Run a generator that makes requests on a problem; return its value."""

    def run(steps, problem):
        responder, reply = Responder(problem, 0.0), None
        while True:
            try:
                request = next(steps) if reply is None else steps.send(reply)
            except StopIteration as end:
                return end.value
            (reply,) = responder.respond([request])

    return run
