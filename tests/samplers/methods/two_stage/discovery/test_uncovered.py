"""Two half-spaces, of which a proposal knows the first only; chains from failures of the second find it."""

import numpy as np
import pytest

from samplers.methods.two_stage.candidates import build_proposal
from samplers.methods.two_stage.discovery.uncovered import cover_failures, find_uncovered
from samplers.methods.two_stage.mixture.proposal import MixtureProposal
from samplers.methods.two_stage.multiple_importance import MultipleImportanceSample
from samplers.methods.two_stage.refinement import start_refinement, typical_weights
from samplers.methods.two_stage.regions import ExplorationResult
from samplers.methods.two_stage.settings import RefinementSettings
from samplers.methods.two_stage.simulator import ComponentDraws, Simulator
from samplers.problem import FunctionProblem

SETTINGS = RefinementSettings()
BETA = 3.0
PROBLEM = FunctionProblem(lambda u: BETA - u[:, :2].max(axis=1), 4)
N = 1000


@pytest.fixture
def known(exact_region, rng):
    """The state that knows the first half-space, its proposal, and a history with one draw in the second."""
    exploration = ExplorationResult([exact_region(PROBLEM, 0, BETA)], noisy=False)
    state = start_refinement(exploration, 0.0, SETTINGS, rng)
    empty = MultipleImportanceSample.empty(4)
    proposal = build_proposal(state, empty, SETTINGS)
    # no draw of N(0, 1.5^2 I), which would be seen to reach the second half-space
    weights = np.where([one.kind == "wide" for one in proposal.candidates], 0.0, proposal.weights)
    proposal = MixtureProposal(proposal.candidates, weights / weights.sum())
    u, counts = proposal.draw(600, rng)
    first = counts.cumsum()[0]
    u[:first, :2] = 0.0  # base draws
    u[0] = (0.0, BETA + 0.1, 0.0, 0.0)
    history = empty.add(ComponentDraws(proposal.components, counts, u, PROBLEM.evaluate(u)), 0.0)
    return state, proposal, history


def test_failures_are_uncovered_where_one_draw_would_be_much_of_p(known):
    state, proposal, history = known
    found = find_uncovered(state, history, proposal, N)
    p = np.exp(history.log_weights).sum()
    share = np.exp(proposal.log_weights(found)) / (N * p)
    assert len(found) >= 1
    assert (found[:, 1] >= BETA).all()  # the first half-space is known
    assert (np.diff(share) <= 0).all()
    assert share[-1] > SETTINGS.uncovered_share
    assert len(find_uncovered(state, history, proposal, 1000 * N)) == 0


def test_chains_from_them_give_their_region_components(known, rng, drive):
    state, proposal, history = known
    found = find_uncovered(state, history, proposal, N)
    simulator = Simulator(PROBLEM)
    covered, f = drive(cover_failures(simulator, state, found, 400, rng), PROBLEM)
    assert len(f) == simulator.n_sim <= 400
    assert len(covered.regions) == 2
    assert (covered.regions[1].points[:, 1] >= BETA).all()
    assert {one.region for one in (*covered.explored, *covered.linear)} == {0, 1}
    assert len(covered.gaussians) == len(covered.explored)
    before = typical_weights(covered, proposal)
    after = typical_weights(covered, build_proposal(covered, history, SETTINGS))
    assert before[1] > 10 * after[1]
    assert len(state.regions) == 1  # as it was


def test_without_room_or_without_such_failures_nothing_changes(known, rng):
    state, proposal, history = known
    found = find_uncovered(state, history, proposal, N)
    for points, room in ((found, 24), (found[:0], 400)):
        with pytest.raises(StopIteration) as end:  # before it asks for any outcome
            next(cover_failures(Simulator(PROBLEM), state, points, room, rng))
        assert end.value.value is state
