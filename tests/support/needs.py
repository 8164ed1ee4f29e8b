"""What some tests need of the machine: they skip by its name where it is absent."""

import ctypes

import pytest


def town():
    """Panda3D, and the system library that its software renderer is linked with."""
    pytest.importorskip("panda3d", reason="the town needs the extra roadproof[town]")
    try:
        ctypes.CDLL("libX11.so.6")
    except OSError:
        pytest.skip("the town needs the system package libx11-6", allow_module_level=True)
