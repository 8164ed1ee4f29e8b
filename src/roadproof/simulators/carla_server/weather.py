"""CARLA's weather parameters and the town's eight weathers."""

from __future__ import annotations

from collections.abc import Sequence

from roadproof.datatypes import Weather

CLOUDINESS, PRECIPITATION, DEPOSITS, ALTITUDE, FOG = 0, 1, 2, 5, 6
CLEAR: tuple[float, ...] = (5, 0, 0, 10, -1, 45, 2, 0.75, 0.1, 0, 1, 0.03, 0.0331, 0)
"""CARLA's ClearNoon: cloudiness, precipitation, its deposits, wind, the sun's azimuth and altitude, fog density, its
distance and falloff, wetness, three kinds of scattering, dust."""

# Cloudiness, precipitation, deposits, altitude of the sun, fog: of CARLA's presets of these names; the fog is our own.
_SEEN: dict[Weather, tuple[float, float, float, float, float]] = {
    Weather.CLEAR_NOON: (5, 0, 0, 45, 2),
    Weather.CLOUDY_NOON: (60, 0, 0, 45, 3),
    Weather.WET_NOON: (5, 0, 50, 45, 3),
    Weather.RAINY_NOON: (60, 60, 60, 45, 3),
    Weather.HARD_RAIN_NOON: (100, 100, 90, 45, 7),
    Weather.CLEAR_SUNSET: (5, 0, 0, 15, 2),
    Weather.CLOUDY_SUNSET: (60, 0, 0, 15, 3),
    Weather.FOGGY_MORNING: (40, 0, 0, 25, 60),
}
_SPAN = (100.0, 100.0, 100.0, 45.0, 100.0)


def nearest_weather(parameters: Sequence[float]) -> Weather:
    """Which of the town's weathers is most like CARLA's parameters."""
    given = [parameters[i] for i in (CLOUDINESS, PRECIPITATION, DEPOSITS, ALTITUDE, FOG)]

    def away(weather: Weather) -> float:
        return sum(((a - b) / span) ** 2 for a, b, span in zip(given, _SEEN[weather], _SPAN, strict=True))

    return min(_SEEN, key=away)
