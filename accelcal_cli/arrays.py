"""The array types of all packages: numbers, indices, truth values."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.floating[Any]]
Int = NDArray[np.intp]
Bool = NDArray[np.bool_]
