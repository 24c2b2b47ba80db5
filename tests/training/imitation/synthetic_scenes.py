"""Small trainings for tests: scenes of cars that speed up, slow down and sway, recorded exactly, and settings."""

import dataclasses

import numpy as np
import torch

from agents.learned.networks import Policy, Scaling
from training.data.scenes import TrafficScene
from training.imitation.config import Config
from training.imitation.traffic import start_replay

DT = 0.1
EDGES = (0.0, 3.6, 7.2, 10.8)
TINY = Config(
    updates=6,
    epochs=1,
    batch=64,
    pools=2,
    scenes=2,
    horizon=(3, 5),
    age=(6, 9),
    critic_batch=32,
    warm_up=2,
    ppo_batch=40,
)


def scene(seed=0, ticks=60, vehicles=9, name="made up"):
    """Cars 25 m apart in each lane, moved by the simulator's own explicit Euler steps."""
    rng = np.random.default_rng(seed)
    lane = np.arange(vehicles) % 3
    x = np.zeros((ticks, vehicles))
    y, heading, speed = (np.zeros_like(x) for _ in range(3))
    x[0] = 25.0 * (np.arange(vehicles) // 3) + rng.uniform(0, 5, vehicles)
    y[0] = 1.8 + 3.6 * lane + rng.uniform(-0.3, 0.3, vehicles)
    speed[0] = rng.uniform(10, 12, vehicles)
    phase = rng.uniform(0, 2 * np.pi, (2, vehicles))
    time = DT * np.arange(ticks)[:, None]
    acceleration = 0.6 * np.cos(1.3 * time + phase[0])
    yaw_rate = 0.02 * np.cos(1.7 * time + phase[1])
    for t in range(ticks - 1):
        x[t + 1] = x[t] + speed[t] * np.cos(heading[t]) * DT
        y[t + 1] = y[t] + speed[t] * np.sin(heading[t]) * DT
        heading[t + 1] = heading[t] + yaw_rate[t] * DT
        speed[t + 1] = speed[t] + acceleration[t] * DT
    present = np.ones(x.shape, dtype=bool)
    for values in (x, y, heading, speed):  # one car is in view for the first half only
        values[ticks // 2 :, -1] = np.nan
    present[ticks // 2 :, -1] = False
    for values in (acceleration, yaw_rate):
        values[ticks // 2 - 1 :, -1] = np.nan
        values[-1] = np.nan
    sizes = np.full(vehicles, 4.5), np.full(vehicles, 1.9)
    return TrafficScene(name, 0.0, EDGES, x, y, heading, speed, acceleration, yaw_rate, present, *sizes)


def scenes(number=3, **settings):
    return tuple(scene(seed, name=f"made up {seed}", **settings) for seed in range(number))


def tiny(**settings):
    return dataclasses.replace(TINY, **settings)


SMALL = tiny(updates=12, pools=1, horizon=(6, 6), age=(6, 6), warm_up=0, ppo_batch=80)
"""One pool that is always new, and the policy moves from the first round on."""


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def plain_policy():
    scaling = Scaling(torch.zeros(51), torch.ones(51), torch.tensor([0.5, 0.0]), torch.tensor([2.0, 0.1]))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Policy(scaling)


def at_start(recording, tick=0):
    rows = torch.arange(len(recording.x))
    return start_replay(recording, rows, torch.full_like(rows, tick))
