"""Export: driven scenarios as files that other simulators open."""

from typing import TYPE_CHECKING

from rare_envs.plugins import make_lazy_getattr

if TYPE_CHECKING:
    from rare_envs.study.export.writing import EXPORT_FORMATS, export_drive, export_scenario

__all__ = ["EXPORT_FORMATS", "export_drive", "export_scenario"]

_LAZY = {
    "EXPORT_FORMATS": "rare_envs.study.export.writing",
    "export_drive": "rare_envs.study.export.writing",
    "export_scenario": "rare_envs.study.export.writing",
}

__getattr__ = make_lazy_getattr(__name__, _LAZY)
