"""Open3D, with the libusb-1.0 that it links against taken from a wheel, so that no system package is needed.

`from palpate_reproduction.open3d_loader import open3d` is the only way in which this package imports Open3D.
"""

from __future__ import annotations

import ctypes

import libusb_package

_libusb = ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
"""Kept alive: Open3D resolves its symbols from it."""

import open3d  # noqa: E402  (must follow libusb)

__all__ = ["open3d"]
