"""Which roads and drivers rows side by side are for."""

from rare_envs.control import IDM
from rare_envs.scenarios import straight
from rare_envs.simulation.compiled.equations import IDMNumbers, RoadNumbers
from rare_envs.simulation.compiled.rows_side_by_side import can_stand_side_by_side
from rare_envs.traffic.road import Road


def test_an_ego_beside_its_line_and_another_exponent_are_driven_one_row_after_the_other():
    usual = IDMNumbers.of(IDM())
    for road in (straight(1), straight(2, 2.5), Road((-6.0, -2.0, 2.0))):
        assert can_stand_side_by_side(usual, road=RoadNumbers.of(road))
    assert not can_stand_side_by_side(usual, road=RoadNumbers.of(Road((-1.0, 3.0))))
    assert not can_stand_side_by_side(usual, IDMNumbers.of(IDM(exponent=3.0)), road=RoadNumbers.of(straight(1)))
