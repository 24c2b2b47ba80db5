"""Palette: the colour of each vehicle, the same in every picture, clip and curve, and those of numbers."""

from __future__ import annotations

ROLE_COLOURS = {"ego": "#22aa3c", "lead": "#3b82d6", "cutter": "#f09a1a", "others": "#b4b4c4"}
"""Colours of vehicles by what scenarios call them, on paper and on asphalt; "others" for other names."""
OTHER_COLOURS = ("#8e5aa8", "#3aa6a6", "#7a7a7a", "#b4667e", "#6b7fb0")
"""Colours that tell vehicles of other names apart in curves."""
CRASH_COLOUR = "#d62828"
"""Outline of vehicles that have crashed: they keep their own colour, so that the ego stays the ego."""


def vehicle_colour(name: str, number: int = 0) -> str:
    """Return the colour of a vehicle by its name, or by its number if scenarios call no vehicle so."""
    return OTHER_COLOURS[number % len(OTHER_COLOURS)] if name not in ROLE_COLOURS else ROLE_COLOURS[name]


def as_rgb(colour: str) -> tuple[int, int, int]:
    """Return a colour as numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
