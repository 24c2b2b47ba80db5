"""Report: the answer to a question, with its failures, the kinds of their crashes and the ego's faults."""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

import rare_envs
import samplers
from agents.sb3.saved_ego import SavedEgo
from rare_envs.egos.faults import Fault
from rare_envs.study.crash_kinds import CrashKinds
from rare_envs.study.question import Study


@dataclass(frozen=True)
class Report:
    """Answer to a question.

    Attributes:
        study: The question and what it names.
        estimate: The estimate of the method.
        seconds: Wall time of the estimation [s].
        faults: Scenarios on which the ego failed twice.
        n_retried: Simulations that were repeated to find them; not in n_sim.
        kinds: Crashes in which the failures ended.

    Example:
        >>> from rare_envs.study import Question, prepare, run
        >>> question = Question(env_id="rare_envs/CarFollowing-v0", gamma=3.0, horizon=3.0, method="mc", max_sim=1000)
        >>> report = run(prepare(question))
        >>> answer = report.to_dict()
        >>> answer["n_failures"], answer["doubtful"], answer["failures"][0]["crash"]
        (21, False, None)
    """

    study: Study
    estimate: samplers.Estimate
    seconds: float
    faults: tuple[Fault, ...] = ()
    kinds: CrashKinds = field(default_factory=CrashKinds)
    n_retried: int = 0

    @property
    def doubtful(self) -> bool:
        """Whether the method itself warns that the number may be wrong."""
        return bool(self.estimate.warnings)

    @property
    def crashes(self) -> tuple[dict[str, Any] | None, ...]:
        """The crash of each listed failure, see `rare_envs.traffic.crash.describe_crash`; None where nobody crashed."""
        return self.kinds.listed or (None,) * len(self.estimate.failures)

    @property
    def notes(self) -> tuple[str, ...]:
        """Options that make no difference here, notes of the problem, and what is not known."""
        unknown = (f"kinds of crash are not known: {self.kinds.unknown}",) if self.kinds.unknown else ()
        return (*self._unused_options, *self.study.problem.notes, *unknown)

    @property
    def _unused_options(self) -> tuple[str, ...]:
        world, noise = self.study.problem.world, self.study.question.noise
        if noise is True or world.sensing.weather or (world.background is not None and world.background.noisy):
            return ()
        word = "off" if noise is False else noise
        return (f"--noise {word} changes nothing: nobody in this traffic drives with noise (see --drivers)",)

    @property
    def vec_normalize(self) -> str | None:
        """File of the `VecNormalize` statistics that were applied to a saved ego's observations, if there was one."""
        ego = self.study.problem.ego
        return str(ego.statistics_path) if isinstance(ego, SavedEgo) and ego.statistics_path else None

    def to_dict(self, top: int = 10) -> dict[str, Any]:
        """Return the report as JSON-ready values: question, estimate and the `top` most likely failures."""
        failures = self.estimate.failures
        space = self.study.problem.space
        ranked = [
            {
                "parameters": self._parameters(failure.x),
                "f": failure.f if math.isfinite(failure.f) else None,
                "log_p0": failure.log_p0,
                "crash": crash,
            }
            for failure, crash in itertools.islice(zip(failures, self.crashes, strict=True), top)
        ]
        return {
            **self.estimate.to_dict(),
            "question": asdict(self.study.question),
            "doubtful": self.doubtful,
            "notes": self.notes,
            "vec_normalize": self.vec_normalize,
            "seconds": self.seconds,
            "n_failures": failures.total,
            "kinds": {kind: share.to_dict() for kind, share in self.kinds.shares.items()},
            "severity": None if self.kinds.severity is None else self.kinds.severity.to_dict(),
            "failures": ranked,
            "n_faults": len(self.faults),
            "n_retried": self.n_retried,
            "faults": [
                {"parameters": self._parameters(fault.x), "reason": fault.reason} for fault in self.faults[:top]
            ],
            "units": dict(zip(space.names, space.units, strict=True)),
            "version": rare_envs.__version__,
        }

    def _parameters(self, x: NDArray[np.float64]) -> dict[str, Any]:
        named = self.study.problem.space.named(x)
        return {name: np.asarray(value).tolist() for name, value in named.items()}
