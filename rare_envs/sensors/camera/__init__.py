"""The front camera: pictures by casting rays at road, vehicles and sky, and the weather that changes them."""

from rare_envs.sensors.camera.context import Camera, CameraContext, Weather, clear_day, find_camera
from rare_envs.sensors.camera.picture import take_picture

__all__ = ["Camera", "CameraContext", "Weather", "clear_day", "find_camera", "take_picture"]
