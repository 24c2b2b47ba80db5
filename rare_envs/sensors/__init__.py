"""Sensors: lidar, perception, kinematics, camera, and the kinds of observation made of them."""
