"""CoreChoice: compiled rollouts of a world and its ego where they can be had, torch for all else."""

from __future__ import annotations

import warnings
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rare_envs.control.idm import IDM
from rare_envs.egos.dense_policies import read_dense_policy
from rare_envs.egos.policy import PolicyDriver, find_device_driver
from rare_envs.simulation.compiled.failures import CompilerFails, NotCompiled, check_core
from rare_envs.simulation.compiled.selection import (
    CompiledEgo,
    CompiledRollout,
    find_compiled_rollout,
    select_rollout,
)
from rare_envs.simulation.cuda_graphs import RecordedRollouts
from rare_envs.simulation.episode import Episode
from rare_envs.simulation.rollout import Driver
from rare_envs.simulation.world import World

_CPU = torch.device("cpu")


class CoreChoice:
    """What simulates a world and its ego.

    Attributes:
        wanted: What was asked for, one of `CORES`.
        rollout: The compiled rollout; None where torch simulates.

    Example:
        >>> from rare_envs.scenarios.highway import HIGHWAY
        >>> CoreChoice("auto", World(HIGHWAY), IDM()).rollout is None  # without drivers nobody decides there
        True
    """

    def __init__(self, wanted: str, world: World, driver: Driver, device: torch.device = _CPU, tile: int = 1) -> None:
        """Find the compiled rollout, if what was asked for is one and there is one.

        Args:
            wanted: One of `CORES`.
            world: The world.
            driver: The ego.
            device: Where it is to be simulated.
            tile: Most rollouts that torch makes at once.

        Raises:
            ValueError: There is no such core, or "numba" cannot simulate this.
        """
        check_core(wanted)
        self.wanted, self._driver, self._device, self._tile = wanted, driver, device, tile
        self._recorded: RecordedRollouts | None = None
        self.rollout: CompiledRollout | None = None
        if wanted == "torch":
            return
        try:
            if device.type != "cpu":
                raise NotCompiled(f"compiled rollouts are for the CPU, and device={str(device)!r} was asked for")
            self.rollout = find_compiled_rollout(world, compiled_ego(driver))
        except NotCompiled as reason:
            self._give_up(reason, warns=isinstance(reason, CompilerFails), stacklevel=4)

    def run(self, x: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Return f of scenarios x (n, d), NaN where it is not known; None where torch has to simulate.

        Raises:
            ValueError: Compiled rollouts were asked for, and have become impossible.
        """
        if self.rollout is None:
            return None
        try:
            return self.rollout(x).astype(np.float64)
        except NotCompiled as reason:
            self._give_up(reason, warns=True, stacklevel=6)
            return None

    def roll_out(self, world: World, x: Tensor) -> Episode | None:
        """Return the episodes of scenarios x (B, d), a tile at most, by operations that are recorded.

        Returns:
            None on the CPU, and on a GPU where a policy has to be asked on the CPU: one that cannot decide
            elsewhere, or one that fails, for then it is told on which rows, and how.
        """
        if self._device.type == "cpu":
            return None
        known = self._recorded
        driver = find_device_driver(self._driver, self._device, None if known is None else known.driver)
        if driver is None:
            return None
        if known is None or known.driver is not driver:
            known = self._recorded = RecordedRollouts(driver, self._tile)
        if not isinstance(self._driver, PolicyDriver):
            return known(world, x)
        try:
            end = known(world, x)
        except (Exception, SystemExit):  # the policy is the user's: anything may happen in it
            return None
        return None if has_nan(end) else end

    def _give_up(self, reason: NotCompiled, *, warns: bool, stacklevel: int) -> None:
        """Leave the simulation to torch, or raise a ValueError where that was not asked for."""
        if self.wanted == "numba":
            raise ValueError(f"core='numba' cannot simulate this: {reason}.") from reason
        self.rollout = None
        if warns:
            warnings.warn(f"{reason}; torch simulates, which is slower.", stacklevel=stacklevel)


def has_nan(end: Episode) -> bool:
    """Return whether f or an ego is NaN at the horizon of any episode.

    An action that is NaN leaves the ego so for good; f need not notice, since nobody is seen by or near such an ego.

    Example:
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> has_nan(World(CAR_FOLLOWING).start(torch.tensor([[20.0, 15.0, 30.0]])))
        False
    """
    state = end.state
    own = (values[:, 0] for values in (state.x, state.y, state.heading, state.speed))
    return bool(torch.stack([end.f.isnan(), *(values.isnan() for values in own)]).any())


def compiled_ego(driver: Driver) -> CompiledEgo:
    """Return an ego as compiled rollouts take it.

    Raises:
        NotCompiled: They do not take it.
    """
    if type(driver) is PolicyDriver:
        return partial(read_dense_policy, driver.policy)
    if type(driver) is not IDM:
        raise NotCompiled(f"the ego, a {type(driver).__name__}, is not compiled")
    return driver


def is_compiled_script(world: World, driver: Driver) -> bool:
    """Return whether a world is a script that compiled rollouts know with this ego, with numba or without it.

    Example:
        >>> from rare_envs.scenarios.car_following import CAR_FOLLOWING
        >>> is_compiled_script(World(CAR_FOLLOWING), IDM())
        True
    """
    try:
        select_rollout(world, compiled_ego(driver))
    except NotCompiled:
        return False
    return True
