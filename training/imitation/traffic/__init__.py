"""Recorded scenes as traffic in which drivers learn."""

from training.imitation.traffic.recording import Recording, stack_scenes

__all__ = ["Recording", "stack_scenes"]
