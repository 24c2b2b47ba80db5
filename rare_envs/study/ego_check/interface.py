"""Checks of an ego's interface: declared spaces, normalisation, actions, and observations at their bounds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from gymnasium import spaces

from agents.sb3.saved_ego import SavedEgo
from rare_envs.arrays import AnyArray
from rare_envs.egos.errors import reason_of
from rare_envs.egos.wrappers import find_frame_stacking
from rare_envs.sensors.kinds import map_kinds
from rare_envs.study.ego_check.findings import Finding, report_failure, report_pass, report_warning
from rare_envs.study.ego_check.probe import BATCH_ROWS, Probe

OUTLYING = 5.0
"""Standard deviations of the training; observations beyond are unlike those that the ego was trained on."""
MANY_OUTLYING = 0.2
"""Share of ordinary scenarios with such observations from which the statistics are most likely of another ego."""


def check_declared_spaces(probe: Probe) -> Iterator[Finding]:
    """Compare declared spaces with the environment's; that they fit at all was found when the problem was made."""
    world = probe.problem.world
    ours = probe.space, world.action_space
    # the ego is the user's: it need not declare anything
    observed, acted = (getattr(probe.ego, f"{name}_space", None) for name in ("observation", "action"))
    if observed is None or acted is None:
        missing = " and ".join(
            name for name, space in (("observation_space", observed), ("action_space", acted)) if space is None
        )
        yield report_warning(
            "spaces",
            f"it has no {missing}",
            "taken at its word; declare them, so that a mix-up is noticed",
            False,
        )
    if observed is not None:
        frames, _ = find_frame_stacking(ours[0], observed) or (1, False)
        stacked = f", {frames} frames of {ours[0].shape or ours[0]}" if frames > 1 else ""
        words = f"{observed.shape} {observed.dtype}" if observed.shape is not None else str(observed)
        yield report_pass("observations", f"{words}{stacked}")
        if observed.dtype is not None and np.issubdtype(observed.dtype, np.floating) != np.issubdtype(
            ours[0].dtype, np.floating
        ):
            yield report_warning(
                "observations", f"it was made for {observed.dtype}, here they are {ours[0].dtype}", "train it on these"
            )
    if isinstance(acted, spaces.Box) and isinstance(ours[1], spaces.Box):
        same = np.array_equal(acted.low, ours[1].low) and np.array_equal(acted.high, ours[1].high)
        unbounded = not (np.isfinite(acted.low).any() or np.isfinite(acted.high).any())
        if same or unbounded:
            yield report_pass("action space", "in [-1, 1]" if same else "unbounded; clipped to [-1, 1]")
        else:
            yield report_warning(
                "action space",
                f"from {acted.low.tolist()} to {acted.high.tolist()}, the environment's from -1 to 1",
                "they are rescaled, as behind RescaleAction; if its units differ, put a function of yours around it",
            )
    elif acted is not None:
        yield report_pass("action space", str(acted))


def check_normalisation(probe: Probe) -> Iterator[Finding]:
    """Check whether the VecNormalize statistics of a saved ego suit the observations here."""
    if not isinstance(probe.ego, SavedEgo):
        return
    missing = probe.ego.find_missing_statistics(probe.space)
    if missing:
        yield report_warning(
            "normalisation", f"no VecNormalize statistics, but {missing}", "name their file with --stats"
        )
        return
    if probe.ego.statistics is None:
        yield Finding(
            "normalisation",
            "pass",
            "no VecNormalize statistics beside the file",
            "if it was trained behind VecNormalize, put vecnormalize.pkl there, or name it with --stats",
        )
        return
    statistics = probe.ego.statistics
    if not statistics.norm_obs:
        yield report_pass("normalisation", f"{probe.ego.statistics_path} does not normalise observations")
        return
    if isinstance(probe.seen, dict) or probe.seen.ndim > 2:
        yield report_pass(
            "normalisation", f"{probe.ego.statistics_path}; of such observations their fit is not checked"
        )
        return
    single = statistics.observation_space.shape == probe.seen.shape[1:]
    seen = (
        probe.seen if single else np.repeat(probe.seen, statistics.observation_space.shape[0] // probe.seen.shape[1], 1)
    )
    beyond = float((np.abs(statistics.normalize_obs(seen)) > OUTLYING).any(axis=1).mean())
    result = (
        f"{probe.ego.statistics_path}: {beyond:.0%} of ordinary scenarios are over {OUTLYING:g} standard deviations off"
    )
    if beyond > MANY_OUTLYING:
        yield report_warning(
            "normalisation", result, "are these the statistics of this policy, and of this environment?"
        )
    else:
        yield report_pass("normalisation", result)


def check_actions(probe: Probe) -> Iterator[Finding]:
    """Check shape, type and range of actions on ordinary observations."""
    action, _ = probe.query(probe.seen)
    declared = getattr(probe.ego, "action_space", None)  # likewise
    whole = np.issubdtype(action.dtype, np.integer)
    expected = (BATCH_ROWS,) if whole else (BATCH_ROWS, 2)
    if action.shape != expected or action.dtype == object:
        yield report_failure(
            "actions",
            f"{action.dtype} of shape {action.shape}",
            f"return shape {(BATCH_ROWS, 2)}, or {BATCH_ROWS} whole numbers",
        )
        return
    if not np.isfinite(action).all():
        bad = int((~np.isfinite(action)).reshape(BATCH_ROWS, -1).any(axis=1).sum())
        yield report_failure(
            "actions", f"NaN or infinite for {bad} of {BATCH_ROWS} observations", "check weights and normalisation"
        )
        return
    if isinstance(declared, spaces.Discrete) != whole and declared is not None:
        yield report_failure(
            "actions", f"{action.dtype} of shape {action.shape}, but it says {declared}", "make both agree"
        )
        return
    beyond = 0.0 if whole else float((np.abs(action) > 1.0 + 1e-6).mean())
    if beyond:
        yield report_warning(
            "actions",
            f"{beyond:.0%} beyond [-1, 1], up to {np.abs(action).max():.3g}",
            "they are clipped",
            False,
        )
    if len(np.unique(action.round(6), axis=0)) == 1:
        yield report_warning(
            "actions", f"the same for all {BATCH_ROWS} observations: {action[0].tolist()}", "does it look at all?"
        )
    else:
        yield report_pass("actions", f"{action.dtype} of shape (B{', 2' if not whole else ''}), finite")


def check_extreme_observations(probe: Probe) -> Iterator[Finding]:
    """Query the ego with zeros (rows whose episode is over), with the bounds of its observations, and with NaN."""
    space = probe.space
    boxes = dict(space.spaces) if isinstance(space, spaces.Dict) else space
    cases = {
        "zeros": probe.transform_seen(np.zeros_like),
        "the lower end": map_kinds(lambda part, box: _fill_with_bound(box.low, -1.0, part), probe.seen, boxes),
        "the upper end": map_kinds(lambda part, box: _fill_with_bound(box.high, 1.0, part), probe.seen, boxes),
    }
    bad = []
    for name, case in cases.items():
        try:
            action, _ = probe.query(case)
            bad += [] if np.isfinite(action).all() else [f"{name}: NaN or infinite"]
        except (Exception, SystemExit) as error:
            bad.append(f"{name}: {reason_of(error)}")
    if bad:
        yield report_failure(
            "range",
            "; ".join(bad),
            "such observations come; rows are zeros after a crash",
        )
    else:
        yield report_pass("range", "finite at zeros and at both ends of what is observed")
    if not isinstance(probe.seen, dict) and probe.seen.dtype == np.uint8:
        return
    try:
        action, _ = probe.query(map_kinds(lambda part: part if part.dtype == np.uint8 else part * np.nan, probe.seen))
        finite = bool(np.isfinite(action).all())
        yield report_pass(
            "NaN", "answered by numbers; the environment never gives NaN" if finite else "answered by NaN"
        )
    except (Exception, SystemExit) as error:
        yield report_pass("NaN", f"refused: {reason_of(error)}")


def _fill_with_bound(bound: AnyArray, unbounded: float, part: AnyArray) -> AnyArray:
    """Return observations at a bound of their space, or at `unbounded` where it has none."""
    return np.broadcast_to(np.where(np.isfinite(bound), bound, unbounded), part.shape).astype(part.dtype)
