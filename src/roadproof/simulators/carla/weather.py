"""CARLA's presets for the eight weathers. The paper's "rainy noon" is taken to be MidRainyNoon."""

from __future__ import annotations

from roadproof.datatypes import Weather
from roadproof.simulators.carla.session import carla

PRESETS = {
    Weather.CLEAR_NOON: "ClearNoon",
    Weather.CLOUDY_NOON: "CloudyNoon",
    Weather.RAINY_NOON: "MidRainyNoon",
    Weather.CLEAR_SUNSET: "ClearSunset",
    Weather.CLOUDY_SUNSET: "CloudySunset",
    Weather.WET_NOON: "WetNoon",
    Weather.HARD_RAIN_NOON: "HardRainNoon",
}
"""Names of CARLA's presets by weather; CARLA has none with fog."""


def carla_weather(weather: Weather) -> carla.WeatherParameters:
    """CARLA's parameters of a weather."""
    if weather in PRESETS:
        return getattr(carla.WeatherParameters, PRESETS[weather])
    return carla.WeatherParameters(
        cloudiness=40.0, wind_intensity=10.0, sun_azimuth_angle=-1.0, sun_altitude_angle=25.0, fog_density=60.0
    )
