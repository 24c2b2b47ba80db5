import numpy as np

from samplers.methods.two_stage.terms.history import TermHistory
from samplers.methods.two_stage.terms.law import ComponentGroup, TermLaw, TermProposal
from samplers.proposals.components import SubspaceGaussian


def shifted(dim, axis, mean):
    law = SubspaceGaussian(np.eye(1), np.array([mean]), np.ones(1))
    return TermProposal(
        dim, 0.2, (TermLaw(np.eye(dim)[:, [axis]], (ComponentGroup(1.0, (law,), np.ones(1)),)),), np.ones(1)
    )


def test_weights_are_those_of_the_mixture_of_all_proposals(rng, half_spaces):
    """Whatever order draws came in: n phi / sum_k n_k q_k; their sum over all draws is near 1."""
    problem, _, _ = half_spaces(5, 0.01)
    u = rng.standard_normal((100, 5))
    history = TermHistory.of_base_draws(u, problem.terms(u))
    proposals = [(200, shifted(5, 0, 2.0)), (300, shifted(5, 1, -1.0))]
    for first, (n, proposal) in zip((150, 400), proposals, strict=True):
        new, _ = proposal.draw(n, rng)
        history = history.add(new, problem.terms(new), proposal, first)
    density = 100 + sum(n * np.exp(proposal.log_ratio(history.u)) for n, proposal in proposals)
    np.testing.assert_allclose(np.exp(history.log_weights), 1 / density, rtol=1e-9)
    w = np.exp(history.log_weights) * 600
    assert abs(w.mean() - 1) < 5 * w.std() / np.sqrt(600)
    assert [(part.first, len(part.log_weights)) for part in history.draw_weights] == [(0, 100), (150, 200), (400, 300)]
    np.testing.assert_array_equal(
        np.concatenate([part.log_weights for part in history.draw_weights]), history.log_weights
    )
    np.testing.assert_array_equal(history.failing(1.0), history.terms.f <= 1.0)
    np.testing.assert_array_equal(history.terms.f, problem.evaluate(history.u))
