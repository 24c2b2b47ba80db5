"""Threads of torch."""

import contextlib
import sys
from collections.abc import Iterator

from rare_envs.startup import end_at_signals, find_missing_libraries, restore_signals


@contextlib.contextmanager
def use_one_thread() -> Iterator[None]:
    """Keep torch to one thread, and let it have as many as before afterwards; for a block or, as decorator, a function.

    Networks and batches this small lose more time to further threads than they gain, and on one thread sums round alike
    on every machine. Without torch, there is nothing to keep.

    Example:
        >>> import torch
        >>> with use_one_thread():
        ...     torch.get_num_threads()
        1
    """
    if find_missing_libraries(("torch",)):
        yield
        return
    if "torch" not in sys.modules:
        end_at_signals()
    import torch  # here, because the command line shows its help without it

    restore_signals()
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
