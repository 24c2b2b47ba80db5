"""Checks of what an ego takes and gives: spaces, normalisation, actions, and what comes at the edges."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from gymnasium import spaces

from rare_envs.control.actions import space_of_actions
from rare_envs.egos.faults import reason_of
from rare_envs.egos.wrappers import frames_of
from rare_envs.sensors.kinds import each
from rare_envs.study.ego_check.findings import Finding, failed, passed, warned
from rare_envs.study.ego_check.probe import ROWS, Array, Probe


def spaces_fit(probe: Probe) -> Iterator[Finding]:
    """Declared spaces against the environment's; that they fit at all was found when the problem was made."""
    world = probe.problem.world
    ours = probe.space, space_of_actions(world.action)
    observed, acts = (getattr(probe.ego, f"{name}_space", None) for name in ("observation", "action"))
    if observed is None or acts is None:
        missing = " and ".join(
            name for name, space in (("observation_space", observed), ("action_space", acts)) if space is None
        )
        yield warned(
            "spaces",
            f"it has no {missing}",
            "taken at its word; declare them, so that a mix-up is noticed",
            False,
        )
    if observed is not None:
        frames, _ = frames_of(ours[0], observed) or (1, False)
        stacked = f", {frames} frames of {ours[0].shape or ours[0]}" if frames > 1 else ""
        words = f"{observed.shape} {observed.dtype}" if observed.shape is not None else str(observed)
        yield passed("observations", f"{words}{stacked}")
        if observed.dtype is not None and np.issubdtype(observed.dtype, np.floating) != np.issubdtype(
            ours[0].dtype, np.floating
        ):
            yield warned(
                "observations", f"it was made for {observed.dtype}, here they are {ours[0].dtype}", "train it on these"
            )
    if isinstance(acts, spaces.Box) and isinstance(ours[1], spaces.Box):
        same = np.array_equal(acts.low, ours[1].low) and np.array_equal(acts.high, ours[1].high)
        unbounded = not (np.isfinite(acts.low).any() or np.isfinite(acts.high).any())
        if same or unbounded:
            yield passed("action space", "in [-1, 1]" if same else "unbounded; clipped to [-1, 1]")
        else:
            yield warned(
                "action space",
                f"from {acts.low.tolist()} to {acts.high.tolist()}, the environment's from -1 to 1",
                "they are clipped, not rescaled; if its units differ, put a function of yours around it",
            )
    elif acts is not None:
        yield passed("action space", str(acts))


def statistics_fit(probe: Probe) -> Iterator[Finding]:
    """VecNormalize statistics, and whether they suit what is observed here."""
    if not hasattr(probe.ego, "statistics_path"):
        return
    if probe.ego.statistics is None:
        yield Finding(
            "normalisation",
            "pass",
            "no VecNormalize statistics beside the file",
            "if it was trained behind VecNormalize, put vecnormalize.pkl there",
        )
        return
    statistics = probe.ego.statistics
    if not statistics.norm_obs:
        yield passed("normalisation", f"{probe.ego.statistics_path} does not normalise observations")
        return
    if isinstance(probe.seen, dict) or probe.seen.ndim > 2:
        yield passed("normalisation", f"{probe.ego.statistics_path}; of such observations their fit is not checked")
        return
    single = statistics.observation_space.shape == probe.seen.shape[1:]
    seen = (
        probe.seen if single else np.repeat(probe.seen, statistics.observation_space.shape[0] // probe.seen.shape[1], 1)
    )
    beyond = float((np.abs(statistics.normalize_obs(seen)) > 5.0).any(axis=1).mean())
    found = f"{probe.ego.statistics_path}: {beyond:.0%} of ordinary scenarios are over 5 standard deviations off"
    if beyond > 0.2:
        yield warned("normalisation", found, "are these the statistics of this policy, and of this environment?")
    else:
        yield passed("normalisation", found)


def acts(probe: Probe) -> Iterator[Finding]:
    """Shape, type and range of actions on ordinary observations."""
    action, _ = probe.ask(probe.seen)
    declared = getattr(probe.ego, "action_space", None)
    whole = np.issubdtype(action.dtype, np.integer)
    expected = (ROWS,) if whole else (ROWS, 2)
    if action.shape != expected or action.dtype == object:
        yield failed(
            "actions",
            f"{action.dtype} of shape {action.shape}",
            f"return shape {(ROWS, 2)}, or {ROWS} whole numbers",
        )
        return
    if not np.isfinite(action).all():
        bad = int((~np.isfinite(action)).reshape(ROWS, -1).any(axis=1).sum())
        yield failed("actions", f"NaN or infinite for {bad} of {ROWS} observations", "check weights and normalisation")
        return
    if isinstance(declared, spaces.Discrete) != whole and declared is not None:
        yield failed("actions", f"{action.dtype} of shape {action.shape}, but it says {declared}", "make both agree")
        return
    beyond = 0.0 if whole else float((np.abs(action) > 1.0 + 1e-6).mean())
    if beyond:
        yield warned(
            "actions",
            f"{beyond:.0%} beyond [-1, 1], up to {np.abs(action).max():.3g}",
            "they are clipped",
            False,
        )
    if len(np.unique(action.round(6), axis=0)) == 1:
        yield warned("actions", f"the same for all {ROWS} observations: {action[0].tolist()}", "does it look at all?")
    else:
        yield passed("actions", f"{action.dtype} of shape (B{', 2' if not whole else ''}), finite")


def at_the_edges(probe: Probe) -> Iterator[Finding]:
    """Zeros (which rows are shown whose episode is over), the ends of the observation's range, and NaN."""
    space = probe.space
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    cases = {
        "zeros": probe.changed(np.zeros_like),
        "the lower end": each(lambda part, box: _end(box.low, -1.0, part), probe.seen, boxes),
        "the upper end": each(lambda part, box: _end(box.high, 1.0, part), probe.seen, boxes),
    }
    bad = []
    for name, case in cases.items():
        try:
            action, _ = probe.ask(case)
            bad += [] if np.isfinite(action).all() else [f"{name}: NaN or infinite"]
        except (Exception, SystemExit) as error:
            bad.append(f"{name}: {reason_of(error)}")
    if bad:
        yield failed(
            "range",
            "; ".join(bad),
            "such observations come; rows are zeros after a crash",
        )
    else:
        yield passed("range", "finite at zeros and at both ends of what is observed")
    if not isinstance(probe.seen, dict) and probe.seen.dtype == np.uint8:
        return
    try:
        action, _ = probe.ask(each(lambda part: part if part.dtype == np.uint8 else part * np.nan, probe.seen))
        finite = bool(np.isfinite(action).all())
        yield passed("NaN", "answered by numbers; the environment never gives NaN" if finite else "answered by NaN")
    except (Exception, SystemExit) as error:
        yield passed("NaN", f"refused: {reason_of(error)}")


def _end(bound: Array, unbounded: float, part: Array) -> Array:
    """Observations at a bound of their space; where it has none they are scaled to [-1, 1]."""
    return np.broadcast_to(np.where(np.isfinite(bound), bound, unbounded), part.shape).astype(part.dtype)
