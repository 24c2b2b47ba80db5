"""Post-encroachment time by hand, and against outlines compared delay by delay."""

import math

import numpy as np
import pytest
import torch

from rare_envs.measures import (
    PET_MAX,
    Trace,
    pet,
)
from rare_envs.traffic.neighbours import lead_of
from rare_envs.traffic.road import straight
from rare_envs.traffic.state import State
from tests.rare_envs.measures.moments import (
    F64,
)
from tests.rare_envs.traffic.slow_boxes import corners


def trace(*paths: tuple[np.ndarray, np.ndarray, np.ndarray], dt: float = 0.1) -> Trace:
    """One episode on a wide road: x, y and heading over time of each vehicle, the ego first."""
    x, y, heading = (torch.from_numpy(np.stack(each, axis=1)[:, None]) for each in zip(*paths, strict=True))
    state = State(x, y, heading, torch.zeros_like(x), torch.zeros(len(x), 1, 0, dtype=F64))
    lead = lead_of(State(*(each[:, 0] for each in state)), straight(9))
    valid = torch.ones(len(x), 1, dtype=torch.bool)
    shaped = lead._replace(gap=lead.gap[:, None], closing_speed=lead.closing_speed[:, None])
    return Trace(state, shaped, straight(9), None, valid, torch.zeros(1, dtype=torch.bool), dt)


def line(x: float, y: float, heading: float, speed: float, dt: float = 0.1) -> tuple[np.ndarray, ...]:
    time = np.arange(round(4.0 / dt) + 1) * dt
    return x + speed * math.cos(heading) * time, y + speed * math.sin(heading) * time, np.full_like(time, heading)


def inside(points: np.ndarray, x: np.ndarray, y: np.ndarray, heading: np.ndarray) -> np.ndarray:
    dx, dy = points[..., 0] - x, points[..., 1] - y
    along, across = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
    return (np.abs(along) < 2.5) & (np.abs(across) < 1.0)


def outline(x: float, y: float, heading: float) -> np.ndarray:
    a = corners(x, y, heading)
    share = np.linspace(0.0, 1.0, 15)[:, None]
    return np.concatenate([p + share * (q - p) for p, q in zip(a, np.roll(a, -1, axis=0), strict=True)])


def test_post_encroachment_time_by_hand() -> None:
    # in the lead's place gap / speed later, whatever the lead's speed
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), line(17.3, 0.0, 0.0, 20.0))).item() == pytest.approx(12.3 / 20.0)
    # the same with the ego in front, and another vehicle far away
    behind, far = line(-17.3, 0.0, 0.0, 20.0), line(0.0, 100.0, 0.0, 20.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), behind, far)).item() == pytest.approx(12.3 / 20.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 20.0), far)).item() == PET_MAX
    # at right angles: the other has left the ego's lane after (1 + 2.5) m / 10 m/s, the ego's front reaches it after
    # (20 - 1 - 2.5) m / 10 m/s
    across = line(20.0, 0.0, math.pi / 2, 10.0)
    assert pet(trace(line(0.0, 0.0, 0.0, 10.0), across)).item() == pytest.approx(1.65 - 0.35, abs=1e-4)
    assert pet(trace(across, line(0.0, 0.0, 0.0, 10.0))).item() == pytest.approx(1.65 - 0.35, abs=1e-4)


def test_post_encroachment_time_is_the_least_delay_with_an_overlap() -> None:
    """Against every pair of moments on a grid of 0.02 s, and points on the bodies' outlines."""
    rng = np.random.default_rng(4)
    for _ in range(8):
        speeds, angle = rng.uniform(6.0, 12.0, 2), rng.uniform(0.3, 2.8)
        start = (20.0 + rng.uniform(-8, 8), -15.0 * math.sin(angle) + rng.uniform(-3, 3))
        fast = [line(0.0, 0.0, 0.0, speeds[0], 0.02), line(*start, angle, speeds[1], 0.02)]
        bodies = [np.stack([outline(*pose) for pose in zip(*each, strict=True)]) for each in fast]
        touch = np.zeros((len(fast[0][0]),) * 2, dtype=bool)
        for k in range(len(touch)):
            touch[k] = inside(bodies[1], *(each[k] for each in fast[0])).any(1)
            touch[:, k] |= inside(bodies[0], *(each[k] for each in fast[1])).any(1)
        ego, other = np.nonzero(touch)
        slow = np.abs(ego - other).min() * 0.02 if len(ego) else PET_MAX
        found = pet(trace(line(0.0, 0.0, 0.0, speeds[0]), line(*start, angle, speeds[1]))).item()
        if slow > 0.02:
            assert found == pytest.approx(slow, abs=0.04)
