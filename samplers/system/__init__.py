"""System: what Linux, macOS and Windows do in different ways."""

from samplers.system.platform_calls import end_process, limit_memory, lock_file, sync_folder

__all__ = ["end_process", "limit_memory", "lock_file", "sync_folder"]
