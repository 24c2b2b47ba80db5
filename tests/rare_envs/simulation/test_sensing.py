"""Sensing: kinds, spaces, and what a camera needs."""

import torch

from rare_envs.sensors.camera import Camera
from rare_envs.simulation.sensing import Sensing


def test_lidar_is_computed_where_it_is_observed_or_needed() -> None:
    assert not Sensing("camera+features").uses_lidar
    assert Sensing("camera+lidar").uses_lidar
    assert Sensing("features", lidar=True).uses_lidar


def test_spaces_are_those_of_the_kinds() -> None:
    assert Sensing("features").space(vehicles=3).shape == (3 + 2 * 4,)
    both = Sensing("camera+speed", Camera(32, 64)).space(vehicles=3)
    assert {name: both[name].shape for name in ("camera", "speed")} == {"camera": (32, 64, 3), "speed": (1,)}


def test_weather_is_part_of_x_where_there_is_weather_and_the_sensors_noise_with_it() -> None:
    def names(sensing: Sensing, noisy: bool) -> list[str]:
        return [each.name for parameters, _ in sensing.weather_distributions(noisy) for each in parameters]

    assert names(Sensing(), noisy=True) == []
    assert names(Sensing(weather=True), noisy=False) == ["fog", "sun_elevation", "sun_azimuth"]
    assert names(Sensing(weather=True), noisy=True)[-1] == "sensor_noise"


def test_a_camera_starts_at_tick_0_with_the_weather_of_x() -> None:
    x, key = torch.tensor([[0.01, 30.0, 90.0, 2.0]]), torch.tensor([[0.5]])
    assert Sensing("features", weather=True).start_camera(x, key) is None
    context = Sensing("camera", weather=True).start_camera(x, key)
    assert context is not None
    assert context.tick.tolist() == [0]
    torch.testing.assert_close(context.weather.fog, torch.tensor([0.01]))
    torch.testing.assert_close(context.weather.sun_elevation, torch.tensor([torch.pi / 6]))
    clear = Sensing("camera").start_camera(x[:, :0], key[:, :0])
    assert clear is not None
    assert clear.weather.noise.tolist() == [0.0]
