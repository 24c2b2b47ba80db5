"""System: what Linux, macOS and Windows do in different ways."""

from samplers.system.platform_calls import defer_signals, limit_memory

__all__ = ["defer_signals", "limit_memory"]
