"""Sensors: lidar and perception of learned drivers, HighwayEnv's kinematics, the camera, and kinds of observation."""
