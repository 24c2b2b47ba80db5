"""Devices: where torch simulates."""

import torch


def find_device(name: str) -> torch.device:
    """Return a device by its name, if it is there.

    Args:
        name: "cpu", "cuda" or "cuda:1".

    Raises:
        ValueError: There is no such device here.

    Example:
        >>> find_device("cpu")
        device(type='cpu')
        >>> find_device("gpu")
        Traceback (most recent call last):
            ...
        ValueError: Expected device 'cpu', 'cuda' or 'cuda:1', got 'gpu'.
    """
    try:
        device = torch.device(name)
    except (RuntimeError, TypeError):
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ValueError(f"Expected device 'cpu', 'cuda' or 'cuda:1', got {name!r}.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        found = torch.cuda.device_count()
        raise ValueError(f"device={name!r} is not here: torch {torch.__version__} sees {found} GPUs; take 'cpu'.")
    return device
