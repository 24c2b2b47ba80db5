"""The configuration of an environment under HighwayEnv's names; what the environment was made with stays."""

import warnings
from typing import Any, NoReturn

from rare_envs.make import CONFIGURATION_ARGUMENTS
from rare_envs.plugins import did_you_mean

PICTURE_KEYS = frozenset(
    {
        "screen_width",
        "screen_height",
        "centering_position",
        "scaling",
        "show_trajectories",
        "render_agent",
        "offscreen_rendering",
        "manual_control",
        "real_time_rendering",
    }
)
"""Keys of HighwayEnv's configuration that change neither traffic nor spaces; they are kept, and the picture is ours."""

FRAME_RATE = "simulation_frequency"
"""The key that HighwayEnv's scripts set before they record a video, for more frames."""


class FixedConfiguration(dict[str, Any]):
    """A configuration that is read like a dictionary, and refuses to set what is fixed when the environment is made.

    The frame rate stays too, but with a warning: HighwayEnv's scripts set it after the training, for a smoother video.
    A copy, a deep copy and a pickled one are plain dictionaries.

    Args:
        values: By HighwayEnv's key; dictionaries in it refuse likewise.

    Example:
        >>> config = FixedConfiguration({"duration": 10.0, "screen_width": 600})
        >>> config["screen_width"] = 900
        >>> config["duration"] = 40.0
        Traceback (most recent call last):
            ...
        ValueError: Expected config['duration'] to stay 10.0, got 40.0; it is fixed when the environment is made: give \
gym.make the argument horizon.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        """Take over the values."""
        super().__init__(
            {name: FixedConfiguration(value) if isinstance(value, dict) else value for name, value in values.items()}
        )

    def __setitem__(self, name: str, value: Any) -> None:
        """Set a key of the picture, or another one to the value that it has.

        Raises:
            ValueError: If the value would change, of another key than the frame rate.
        """
        if name in PICTURE_KEYS:
            super().__setitem__(name, value)
        elif name not in self:
            raise ValueError(f"Unknown key {name!r}{did_you_mean(name, self)} of config; it has {', '.join(self)}.")
        elif self[name] != value and name == FRAME_RATE:
            warnings.warn(
                f"config[{name!r}] stays {self[name]!r}, not {value!r}: the time between frames is fixed when the "
                "environment is made, by gym.make's argument dt.",
                stacklevel=2,
            )
        elif self[name] != value:
            argument = CONFIGURATION_ARGUMENTS.get(name)
            advice = f"give gym.make the argument {argument}" if argument else "it belongs to the scenario"
            raise ValueError(
                f"Expected config[{name!r}] to stay {self[name]!r}, got {value!r}; "
                f"it is fixed when the environment is made: {advice}."
            )

    def update(self, *others: Any, **values: Any) -> None:
        """Set each of some keys.

        Raises:
            ValueError: If one of the values would change; those before it are set.
        """
        for name, value in dict(*others, **values).items():
            self[name] = value

    def __ior__(self, other: Any) -> "FixedConfiguration":  # type: ignore[misc, override]
        self.update(other)
        return self

    def setdefault(self, name: str, default: Any = None) -> Any:
        """Return the value of a key, set if it is one of the picture and was missing."""
        if name not in self:
            self[name] = default
        return self[name]

    def _refuse(self, *_: Any) -> NoReturn:
        raise ValueError(
            "Expected config to keep its keys, got a removal; copy it with dict(config) to change the copy."
        )

    __delitem__ = pop = popitem = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (dict(self),)
