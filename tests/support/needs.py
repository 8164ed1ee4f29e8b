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


def egl():
    """OpenGL without a screen: the library, and a driver, which Mesa's runs on any CPU."""
    town()
    from roadproof.errors import SimulatorError
    from roadproof.scenarios import find_scenario
    from roadproof.simulators.town.simulator import TownSimulator

    try:
        with TownSimulator(graphics="egl") as simulator:
            simulator.reset(find_scenario("straight-01"))
    except SimulatorError:
        pytest.skip("the town drawn by OpenGL needs the system packages libegl1 and libgl1-mesa-dri")
