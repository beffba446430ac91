"""Depth images of messages as arrays: either unit, either byte order, padded rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from palpate_bus.messages import Image
from palpate_bus.messages.images import depth_in_metres
from palpate_bus.messages.stamps import header

METRES = np.array([[1.0, np.nan, 0.731], [0.5, 2.25, np.nan]], np.float32)


def image(encoding: str, pixels: np.ndarray, big_endian: bool, padding: int) -> Any:
    rows = np.zeros((2, 3 * pixels.itemsize + padding), np.uint8)
    rows[:, : 3 * pixels.itemsize] = pixels.view(np.uint8).reshape(2, -1)
    return Image(header(0, "c"), 2, 3, encoding, int(big_endian), rows.shape[1], rows.ravel())


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "mono16"])
def test_depth_is_in_metres_with_nan_where_there_is_none(encoding: str, big_endian: bool, padding: int) -> None:
    order = ">" if big_endian else "<"
    millimetres = np.nan_to_num(1000 * METRES).round().astype(f"{order}u2")
    pixels = METRES.astype(f"{order}f4") if encoding == "32FC1" else millimetres
    found = depth_in_metres("camera", image(encoding, pixels, big_endian, padding))
    np.testing.assert_allclose(found, METRES, rtol=1e-6)


@pytest.mark.parametrize("invalid", [0.0, -1.0, np.inf])
def test_no_distance_is_nan(invalid: float) -> None:
    pixels = METRES.copy()
    pixels[0, 0] = invalid
    assert np.isnan(depth_in_metres("camera", image("32FC1", pixels, False, 0))[0, 0])


def test_what_is_no_depth_image_is_named() -> None:
    with pytest.raises(ValueError, match="camera: encoding = 'rgb8', want one of 32FC1"):
        depth_in_metres("camera", image("rgb8", np.zeros((2, 3), np.uint8), False, 0))
    short = image("32FC1", METRES, False, 0)
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="camera: 23 bytes for 2 rows of 12, 3 pixels each"):
        depth_in_metres("camera", short)
    narrow = image("16UC1", np.zeros((2, 3), "<u2"), False, 0)
    narrow.step = 4
    with pytest.raises(ValueError, match="12 bytes for 2 rows of 4"):
        depth_in_metres("camera", narrow)
