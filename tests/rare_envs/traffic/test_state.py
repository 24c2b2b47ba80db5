"""States: sizes of vehicles and lanes, and the same traffic seen from another vehicle."""

import copy
import pickle

import torch

from rare_envs.traffic.state import State


def numbered(vehicles: int) -> State:
    """Two scenarios in which every number is another; those of vehicle j end with j."""
    own = torch.arange(vehicles)
    fields = [100 * field + torch.stack((own, 1000 + own)) for field in range(1, 5)]
    return State(*fields, theta=torch.tensor([[7.0], [8.0]]))


def test_another_vehicle_takes_the_place_of_the_ego_and_the_rest_keep_their_order() -> None:
    state = numbered(4)
    for vehicle, order in enumerate(([0, 1, 2, 3], [1, 0, 2, 3], [2, 0, 1, 3], [3, 0, 1, 2])):
        seen = state.seen_by(vehicle)
        for field, before in zip(seen[:4], state[:4], strict=True):
            assert (field % 100).tolist() == [order, order]
            assert torch.equal(field - field % 100, before - before % 100)  # no mixture of fields or scenarios
        assert seen.theta is state.theta


def test_a_changed_or_copied_state_has_its_own_vehicles() -> None:
    state = State.of_vehicles(numbered(2).vehicles, torch.zeros(2, 0))
    faster = state._replace(speed=state.speed + 1)
    assert torch.equal(faster.vehicles[1].speed, state.vehicles[1].speed + 1)
    copied = copy.deepcopy(state)
    copied.x.zero_()
    assert copied.vehicles[1].x.eq(0).all()
    assert state.vehicles[1].x.ne(0).all()
    plain = State(*(field.clone() for field in state))
    assert len(pickle.dumps(state)) < 1.5 * len(pickle.dumps(plain))  # columns would each bring the table of all
    back = pickle.loads(pickle.dumps(state))
    assert torch.equal(back.vehicles[1].speed, state.vehicles[1].speed)
