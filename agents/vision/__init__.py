"""The ego that drives by camera: its network, its checkpoint and its driving."""
