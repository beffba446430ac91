"""Arrays of a message brought to the type and layout that their field has."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def array_dtype(base: str) -> np.dtype[Any]:
    """The type of an array of a ROS base type: ROS's char is an unsigned byte."""
    return np.dtype("uint8" if base == "char" else base)


def fitted(value: Any, dtype: np.dtype[Any], length: int | None, field: str) -> NDArray[Any]:
    """`value` as a contiguous array of `dtype`, shape (length,), or of any length where that is None.

    Raises ValueError that names the field if the shape is another, or if numbers would lose their meaning (text, complex numbers,
    fractions for an integer field).
    """
    array: NDArray[Any]
    if value.__class__ is np.ndarray and value.dtype == dtype and value.flags.c_contiguous:
        array = value
    else:
        array = np.asarray(value)
        if not (np.can_cast(array.dtype, dtype, "same_kind") or array.size == 0):
            raise ValueError(f"{field}: has {array.dtype}, wants {dtype}")
        array = np.ascontiguousarray(array, dtype) if array.ndim else array
    if array.ndim != 1 or (length is not None and array.size != length):
        raise ValueError(f"{field}: has shape {array.shape}, wants ({'n' if length is None else length},)")
    return array
