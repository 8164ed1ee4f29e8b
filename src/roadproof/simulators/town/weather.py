"""The eight weathers as light, air and water.

Convention:
    Light is linear; a surface is shown with level albedo × √light, where albedo is a display level. All light of a
    weather stays ≤ 1 after the root, because the renderer clamps there and a clamp would bend colours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, UInt8

from roadproof.datatypes import Weather
from roadproof.simulators.town.textures import fractal_noise

Rgb = tuple[float, float, float]
Vector = Float[np.ndarray, " 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Sky:
    """One weather.

    Args:
        sun: direction to the sun, any length.
        sunlight: linear light of the sun on a surface that faces it.
        skylight: linear light of the open sky from all around.
        shadow: how much of the sunlight a shadow takes, in [0, 1].
        shadow_blur_m: softness of a shadow's edge, metres.
        haze: colour of the air.
        density_per_m: how fast things fade into the haze, per metre.
        zenith: colour of the sky above.
        horizon: colour of the sky at the horizon.
        clouds: share of the sky that clouds cover, in [0, 1].
        cloud_light: colour of a lit cloud.
        wetness: how wet the ground is: 0 dry, 1 puddles everywhere.
        drops: how many rain streaks are in front of the lens.
    """

    sun: Rgb
    sunlight: Rgb
    skylight: Rgb
    shadow: float
    shadow_blur_m: float = 0.15
    haze: Rgb
    density_per_m: float
    zenith: Rgb
    horizon: Rgb
    clouds: float
    cloud_light: Rgb = (0.96, 0.96, 0.97)
    wetness: float = 0.0
    drops: int = 0

    @property
    def to_sun(self) -> Vector:
        """Unit vector to the sun."""
        vector = np.array(self.sun)
        return vector / np.linalg.norm(vector)

    def light(
        self, facing: Float[np.ndarray, "*n"], sunlit: Float[np.ndarray, "*n"], open_sky: Float[np.ndarray, "*n"]
    ) -> Float[np.ndarray, "*n 3"]:
        """What an albedo is multiplied with, at most 1.

        Args:
            facing: cosine between the surface and the sun, clipped at 0.
            sunlit: 1 in the sun, 0 in a full shadow.
            open_sky: share of the sky that is seen (ambient occlusion).
        """
        sunlight, skylight = (np.array(light, sunlit.dtype) for light in (self.sunlight, self.skylight))
        sun = (facing * (1 - self.shadow * (1 - sunlit)))[..., None] * sunlight
        return np.minimum(np.sqrt(sun + open_sky[..., None] * skylight), 1.0)


_DAY: Rgb = (0.45, -0.35, 0.82)
_LOW: Rgb = (-0.80, 0.52, 0.34)

SKIES: dict[Weather, Sky] = {
    Weather.CLEAR_NOON: Sky(
        sun=_DAY, sunlight=(0.64, 0.60, 0.52), skylight=(0.34, 0.37, 0.42), shadow=0.95,
        haze=(0.76, 0.83, 0.91), density_per_m=0.0026, zenith=(0.22, 0.45, 0.82), horizon=(0.74, 0.85, 0.95),
        clouds=0.30, cloud_light=(1.0, 1.0, 1.0),
    ),
    Weather.CLOUDY_NOON: Sky(
        sun=(0.3, -0.2, 0.93), sunlight=(0.13, 0.13, 0.13), skylight=(0.62, 0.64, 0.67), shadow=0.6, shadow_blur_m=1.5,
        haze=(0.74, 0.76, 0.79), density_per_m=0.0055, zenith=(0.60, 0.65, 0.71), horizon=(0.82, 0.84, 0.86),
        clouds=0.95, cloud_light=(0.80, 0.81, 0.83),
    ),
    Weather.RAINY_NOON: Sky(
        sun=(0.3, -0.2, 0.93), sunlight=(0.04, 0.04, 0.04), skylight=(0.46, 0.48, 0.52), shadow=0.4, shadow_blur_m=1.5,
        haze=(0.58, 0.61, 0.65), density_per_m=0.0110, zenith=(0.46, 0.50, 0.55), horizon=(0.64, 0.67, 0.70),
        clouds=1.0, cloud_light=(0.56, 0.58, 0.61), wetness=0.7, drops=110,
    ),
    Weather.CLEAR_SUNSET: Sky(
        sun=_LOW, sunlight=(0.86, 0.50, 0.24), skylight=(0.22, 0.22, 0.29), shadow=0.95,
        haze=(0.86, 0.66, 0.50), density_per_m=0.0042, zenith=(0.28, 0.36, 0.62), horizon=(0.98, 0.70, 0.46),
        clouds=0.5, cloud_light=(1.0, 0.76, 0.60),
    ),
    Weather.CLOUDY_SUNSET: Sky(
        sun=_LOW, sunlight=(0.22, 0.13, 0.09), skylight=(0.34, 0.30, 0.33), shadow=0.7, shadow_blur_m=1.0,
        haze=(0.66, 0.56, 0.54), density_per_m=0.0060, zenith=(0.40, 0.40, 0.48), horizon=(0.82, 0.62, 0.52),
        clouds=0.92, cloud_light=(0.66, 0.54, 0.54),
    ),
    Weather.WET_NOON: Sky(
        sun=(0.52, 0.30, 0.72), sunlight=(0.56, 0.54, 0.49), skylight=(0.33, 0.36, 0.40), shadow=0.9, shadow_blur_m=0.3,
        haze=(0.74, 0.79, 0.84), density_per_m=0.0045, zenith=(0.36, 0.52, 0.76), horizon=(0.80, 0.85, 0.90),
        clouds=0.62, wetness=0.5,
    ),
    Weather.HARD_RAIN_NOON: Sky(
        sun=(0.3, -0.2, 0.93), sunlight=(0.02, 0.02, 0.02), skylight=(0.34, 0.36, 0.40), shadow=0.3, shadow_blur_m=1.5,
        haze=(0.50, 0.53, 0.57), density_per_m=0.0210, zenith=(0.36, 0.39, 0.44), horizon=(0.52, 0.55, 0.59),
        clouds=1.0, cloud_light=(0.44, 0.46, 0.49), wetness=1.0, drops=330,
    ),
    Weather.FOGGY_MORNING: Sky(
        sun=(0.70, -0.55, 0.40), sunlight=(0.14, 0.13, 0.10), skylight=(0.46, 0.48, 0.51), shadow=0.5,
        shadow_blur_m=1.5, haze=(0.76, 0.77, 0.78), density_per_m=0.0300,
        zenith=(0.72, 0.74, 0.77), horizon=(0.77, 0.78, 0.79),
        clouds=0.8, cloud_light=(0.78, 0.79, 0.80), wetness=0.15,
    ),
}  # fmt: skip


@lru_cache(maxsize=len(SKIES))
def sky_picture(sky: Sky) -> UInt8[np.ndarray, "h w 3"]:
    """The sky all around: columns are azimuth from x towards y, rows go from the zenith to the horizon."""
    height, width = 256, 1024
    up = np.linspace(1, 0, height, dtype=np.float32)[:, None]
    azimuth = (np.arange(width, dtype=np.float32) + 0.5) / width * 2 * math.pi
    blend = (up**0.55)[..., None]
    image = np.repeat(np.array(sky.horizon) * (1 - blend) + np.array(sky.zenith) * blend, width, axis=1)
    cover = 0.62 - 0.24 * sky.clouds
    noise = fractal_noise(height, width, seed=20, cells=6, octaves=6)
    cloud = (np.clip((noise - cover) / 0.20, 0, 1) * np.clip(up * 9, 0, 1))[..., None] * 0.85
    shade = (0.82 + 0.36 * fractal_noise(height, width, seed=21, cells=8, octaves=6))[..., None]
    image = image * (1 - cloud) + cloud * np.array(sky.cloud_light) * shade
    sun = sky.to_sun
    elevation = up * (math.pi / 2)
    towards = np.cos(elevation) * (np.cos(azimuth) * sun[0] + np.sin(azimuth) * sun[1]) + np.sin(elevation) * sun[2]
    towards = np.clip(towards, 0, 1)[..., None]
    if sky.shadow > 0.8:
        image = image + towards**60 * np.array(sky.sunlight) * 0.55 + towards**1200 * 1.2
    else:
        image = image + towards**8 * np.array(sky.sunlight) * 0.5
    line = 0.010 + 0.024 * fractal_noise(16, width, seed=22, cells=2, octaves=3)[3]
    line += 0.020 * fractal_noise(64, width, seed=23, cells=8, octaves=4, persistence=0.8)[5]
    seen = math.exp(-sky.density_per_m * 260)
    far = np.array([0.23, 0.28, 0.22]) * np.sqrt(np.array(sky.skylight)) * 1.2
    woods = np.array(sky.haze) * (1 - seen) + far * seen
    ragged = np.clip((line[None] - up) * height / 2, 0, 1)[..., None]
    image = image * (1 - ragged) + woods * ragged
    hazy = (np.clip(1 - up / 0.10, 0, 1) * (1 - seen))[..., None]
    image = image * (1 - hazy) + np.array(sky.haze) * hazy
    return (np.clip(image, 0, 1) * 255 + 0.5).astype(np.uint8)
