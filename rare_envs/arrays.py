"""Types of arrays."""

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""Double precision, in which statistics are computed."""
AnyArray: TypeAlias = NDArray[Any]
"""Observations and actions of any dtype."""
