"""The ego that drives by camera: its network, its checkpoint and its policy."""

from agents.vision.checkpoint import load_vision, read_vision_provenance, save_vision
from agents.vision.ego import VisionEgo
from agents.vision.pilotnet import PilotNet

__all__ = ["PilotNet", "VisionEgo", "load_vision", "read_vision_provenance", "save_vision"]
