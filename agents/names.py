"""Names of the egos and drivers that `load_ego` and `load_driver` know without a file."""

RULE_BASED = "idm"
"""The Intelligent Driver Model with lane keeping."""
LANE_CHANGING = "idm+mobil"
"""The same with lane changes by MOBIL; a driver of the traffic."""
HUMAN = "human"
"""An attentive human driver by a published model."""
VISION = "vision"
"""The shipped ego with a camera."""
SHIPPED_EGOS = ("imitation",)
"""Shipped drivers that were trained to be egos: by their mean actions they keep lane and distance, see docs/egos.md."""
SHIPPED_DRIVERS = ("mgail", "gail")
"""Shipped drivers of the traffic."""
