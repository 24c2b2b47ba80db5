"""Needs of an ego: noise columns are those of its source."""

from rare_envs.scenarios.car_following import CAR_FOLLOWING
from rare_envs.simulation.ego_interface import EgoNeeds
from rare_envs.simulation.world import World


def test_noise_columns_come_from_the_source_in_its_world() -> None:
    class OnePerTick:
        def noise_columns(self, world: World) -> int:
            return world.clock.ticks

    world = World(CAR_FOLLOWING)
    assert EgoNeeds().noise_columns(world) == 0
    assert EgoNeeds(noise=OnePerTick()).noise_columns(world) == world.clock.ticks == 100
