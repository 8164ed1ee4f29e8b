"""Screens for any number of cameras, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable

from roadproof.geometry import CameraModel
from roadproof.simulators.town.engine import Screen

KEPT, KEPT_PIXELS = 16, 1 << 23
"""Most screens, and most pixels of all their pictures together. One alone may be larger; where more are in use, each is
made anew for every picture."""

Lens = tuple[int, int, float]


class Screens:
    """A screen for each size and field of view; those unused for longest are closed where there are too many.

    Args:
        make: makes the screen of a camera.
    """

    def __init__(self, make: Callable[[CameraModel], Screen]) -> None:
        self._make = make
        self._screens: dict[Lens, Screen] = {}

    def of(self, camera: CameraModel) -> Screen:
        """The screen of a camera, which may be used until the next one is asked for."""
        lens = camera.width_px, camera.height_px, camera.fov_deg
        # Taken out and put back, so that the first are those unused for longest.
        screen = self._screens.pop(lens, None)
        if screen is None:
            room = KEPT_PIXELS - camera.width_px * camera.height_px
            while self._screens and (len(self._screens) >= KEPT or sum(w * h for w, h, _ in self._screens) > room):
                self._screens.pop(next(iter(self._screens))).close()
            screen = self._make(camera)
        screen.camera = camera
        self._screens[lens] = screen
        return screen

    def close(self) -> None:
        """Give all screens back; they are made anew where they are asked for again."""
        for screen in self._screens.values():
            screen.close()
        self._screens.clear()
