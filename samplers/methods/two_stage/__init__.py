"""Two-stage: explore for failure regions, refine a mixture proposal, estimate with fresh draws."""

from samplers.methods.two_stage.method import TwoStage

__all__ = ["TwoStage"]
