"""The same scenes through commonroad-crime, where it is installed; the tests do not install it."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch

from rare_envs.measures import Moment, btn, drac, required_deceleration, thw, ttc
from rare_envs.traffic.neighbours import lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State

pytest.importorskip("commonroad_crime", reason="its dependencies do not fit beside those of the project")
pytestmark = pytest.mark.filterwarnings("ignore")  # of its dependencies
DT = 0.1
TURN = 1e-3
"""Direction of the road [rad]: commonroad-crime takes a direction of exactly 0 for a lane that it has not found."""


def scenario(gap: float, speed: float, lead_speed: float) -> Any:
    """The ego (1) behind a lead (2), both at constant speed on a straight lane, as a CommonRoad scenario."""
    from commonroad.geometry.shape import Rectangle
    from commonroad.prediction.prediction import TrajectoryPrediction
    from commonroad.scenario.lanelet import Lanelet
    from commonroad.scenario.obstacle import DynamicObstacle, ObstacleType
    from commonroad.scenario.scenario import Scenario
    from commonroad.scenario.state import CustomState, InitialState
    from commonroad.scenario.trajectory import Trajectory

    def vehicle(number: int, x: float, v: float) -> Any:
        def values(step: int) -> dict[str, Any]:
            place = (x + v * DT * step) * np.array([np.cos(TURN), np.sin(TURN)])
            return {"time_step": step, "position": place, "orientation": TURN, "velocity": v, "acceleration": 0.0}

        shape = Rectangle(5.0, 2.0)
        rest = [CustomState(**values(step), velocity_y=0.0, acceleration_y=0.0) for step in range(1, 60)]
        path = TrajectoryPrediction(
            Trajectory(1, rest), shape, {k: {1} for k in range(60)}, {k: {1} for k in range(60)}
        )
        start = InitialState(**values(0), yaw_rate=0.0, slip_angle=0.0)
        return DynamicObstacle(
            number, ObstacleType.CAR, shape, start, path, initial_center_lanelet_ids={1}, initial_shape_lanelet_ids={1}
        )

    made = Scenario(DT)
    along = np.linspace(-200.0, 800.0, 401)
    turn = np.array([[np.cos(TURN), np.sin(TURN)], [-np.sin(TURN), np.cos(TURN)]])
    left, middle, right = (np.column_stack((along, np.full_like(along, y))) @ turn for y in (2.0, 0.0, -2.0))
    made.add_objects(Lanelet(left, middle, right, 1))
    made.add_objects([vehicle(11, 0.0, speed), vehicle(12, gap + 5.0, lead_speed)])
    made.assign_obstacles_to_lanelets()
    return made


def crime(gap: float, speed: float, lead_speed: float) -> dict[str, float]:
    """What commonroad-crime says of the first moment."""
    import commonroad_crime.measure as measures
    from commonroad_crime.data_structure.configuration import CriMeConfiguration

    found = {}
    for name in ("TTC", "THW", "ALongReq", "BTN"):
        config = CriMeConfiguration()
        config.vehicle.ego_id = 11
        config.update(sce=scenario(gap, speed, lead_speed))
        found[name] = float(getattr(measures, name)(config).compute(12, 0, verbose=False))
    found["brakes"] = float(config.vehicle.curvilinear.a_lon_max)
    return found


def ours(gap: float, speed: float, lead_speed: float) -> Moment:
    x = torch.tensor([[0.0, gap + 5.0]], dtype=torch.float64)
    state = State(x, 0 * x, 0 * x, torch.tensor([[speed, lead_speed]], dtype=torch.float64), x[:, :0])
    return Moment(state, lead_of(state, straight(1)), straight(1), None, state)


@pytest.mark.parametrize("scene", [(30.0, 20.0, 10.0), (12.5, 25.0, 22.0), (50.0, 30.0, 12.0), (8.0, 15.0, 14.0)])
def test_of_one_lead(scene: tuple[float, float, float]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = crime(*scene)
    now = ours(*scene)
    assert ttc(now).item() == pytest.approx(theirs["TTC"], abs=0.006) or theirs["TTC"] > 10.0  # it rounds
    assert drac(now).item() == pytest.approx(-theirs["ALongReq"], abs=0.006)
    assert required_deceleration(now).item() == pytest.approx(-theirs["ALongReq"], abs=0.006)
    assert btn(now, brakes=theirs["brakes"]).item() == pytest.approx(theirs["BTN"], abs=0.011)
    assert thw(now).item() == pytest.approx(theirs["THW"], abs=1.01 * DT)  # it counts ticks until the ego is there
