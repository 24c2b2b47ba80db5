"""Study: one evaluation as a user runs it, from a question to a report, its folder and its pictures.

The names are imported when they are used, so that the command line starts without torch.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rare_envs.study.compare import EgoComparison, compare_egos
    from rare_envs.study.errors import BadInput
    from rare_envs.study.evaluate import Question, Report, Study, prepare, run
    from rare_envs.study.replay import Drive, drive_again
    from rare_envs.study.run_directory import read_failures, resume, run_into, write_run
    from rare_envs.study.video import write_film

__all__ = [
    "BadInput",
    "Drive",
    "EgoComparison",
    "Question",
    "Report",
    "Study",
    "compare_egos",
    "drive_again",
    "prepare",
    "read_failures",
    "resume",
    "run",
    "run_into",
    "write_film",
    "write_run",
]

_MODULES = {
    "compare": ("EgoComparison", "compare_egos"),
    "errors": ("BadInput",),
    "evaluate": ("Question", "Report", "Study", "prepare", "run"),
    "replay": ("Drive", "drive_again"),
    "run_directory": ("read_failures", "resume", "run_into", "write_run"),
    "video": ("write_film",),
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used."""
    for module, names in _MODULES.items():
        if name in names:
            from importlib import import_module

            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
