"""Limits on paint, as one object: what a search may paint, kept exactly whatever the search.

Limits hold by the way patterns are made (`SearchSpace.pattern`), not by a penalty: every point of the search space
becomes a pattern that obeys, so no step of any search ever leaves them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.constants import placed
from roadproof.errors import PatternError
from roadproof.limits import LEAST_PAINT_M2, MOST_PAINT_M2
from roadproof.paint.colours import AllowedColours, allowed_colours
from roadproof.paint.keepout import KeepOut, keep_out
from roadproof.paint.site import LaneMark, Site, rgb_of
from roadproof.patterns import Pattern

MOST_M = 10.0
"""The largest keep-out, metres."""

MOST_POINTS = 2000
"""The most points of lane marks that are given; every figure is compared with each."""

LIMITS = {
    "max_area_m2": "area",
    "colours": "colours",
    "printable": "print",
    "contrast": "contrast",
    "keep_out_m": "distance from marks",
}
"""The fields that limit something, and what they limit in words."""

ANY = "any"


@dataclass(frozen=True, kw_only=True, slots=True)
class PaintLimits:
    """What paint may be; a field that is left out limits nothing.

    Args:
        max_area_m2: largest sum of the figures' areas, 0.01 to 10,000 m²; the widths of all figures shrink together to
            keep it.
        colours: the only paints allowed, as "#d6a83d"; empty allows all.
        printable: whether offset print must be able to mix the paint (`colours.PRINT`).
        contrast: least and largest contrast of paint to the asphalt; 0 is none, 1 is black on white.
        keep_out_m: least distance of every figure's edge from the edge of every lane mark, metres.
        asphalt: colour of the bare road as paint, such as "#5a5a5b"; measured in the recordings by default.
        marks: lane marks of the road, of 2000 points at most; those that the recordings carry by default.

    Raises:
        PatternError: a value is out of its range, or a list where a tuple is expected.
    """

    max_area_m2: float | None = None
    colours: tuple[str, ...] = ()
    printable: bool = False
    contrast: tuple[float, float] | None = None
    keep_out_m: float | None = None
    asphalt: str | None = None
    marks: tuple[LaneMark, ...] | None = None

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            try:
                hash(value)
            except TypeError:
                raise PatternError(f"{each.name} is {value!r:.80}, expected tuples in place of lists") from None
        if self.max_area_m2 is not None and not LEAST_PAINT_M2 <= self.max_area_m2 <= MOST_PAINT_M2:
            raise PatternError(
                f"max_area_m2 is {self.max_area_m2}, expected {LEAST_PAINT_M2} to {MOST_PAINT_M2:,.0f} m²"
            )
        if self.keep_out_m is not None and not 0.0 <= self.keep_out_m <= MOST_M:
            raise PatternError(f"keep_out_m is {self.keep_out_m}, expected 0 to {MOST_M:g} m")
        if self.contrast is not None:
            if len(self.contrast) != 2:
                raise PatternError(f"contrast is {self.contrast}, expected two numbers, the least and the most")
            least, most = self.contrast
            if not (0.0 <= least <= most - 0.01 + 1e-9 and most <= 1.0):
                raise PatternError(f"contrast is {self.contrast}, expected 0 ≤ least < most ≤ 1, at least 0.01 apart")
        if (points := sum(len(mark.points_m) for mark in self.marks or ())) > MOST_POINTS:
            raise PatternError(f"marks have {points} points, expected {MOST_POINTS} at most; leave out those far away")
        for colour in (*self.colours, *([] if self.asphalt is None else [self.asphalt])):
            rgb_of(colour)

    @property
    def lacks_asphalt(self) -> bool:
        """Whether contrast is limited, but to an asphalt whose colour is still to be measured."""
        return self.contrast is not None and self.asphalt is None

    @property
    def relaxed(self) -> Mapping[str, PaintLimits]:
        """These limits without one of them, by its name in `LIMITS`, and where there are several without `ANY`."""
        usual = {each.name: each.default for each in fields(self)}
        own = {name: usual[name] for name in LIMITS if getattr(self, name) != usual[name]}
        without = {LIMITS[name]: replace(self, **{name: value}) for name, value in own.items()}
        return without | ({ANY: replace(self, **own)} if len(own) > 1 else {})

    def site(self, known: Site) -> Site:
        """The known site, with what these limits themselves say of asphalt and marks in its place."""
        return replace(
            known,
            asphalt=rgb_of(self.asphalt) if self.asphalt else known.asphalt,
            marks=known.marks if self.marks is None else self.marks,
        )

    def check(self, site: Site, *, albedo: tuple[float, float], black: bool, measured: bool = True) -> None:
        """Check that a site is known well enough, and that the limits leave a pattern there.

        Args:
            site: the stretch of road, as `site` returns it.
            albedo: lowest and highest value of a colour channel, each in [0, 1].
            black: whether the search paints only black.
            measured: whether the asphalt must be known by now; False before recordings are made.

        Raises:
            PatternError: the site is not known well enough, or no pattern is left; the message says what to do.
        """
        if site.size_m is None and (self.max_area_m2 is not None or self.keep_out_m is not None):
            raise PatternError(
                "limits in metres need the size of the canvas, which these recordings do not have; give RecordingSet a "
                "canvas"
            )
        if self.keep_out_m is not None and site.marks is None:
            raise PatternError(
                "keep_out_m needs the lane marks, which are not known here; give marks in the file of --paint "
                "(PaintLimits(marks=...)), or record and calibrate again in a simulator with a road map"
            )
        if measured and self.contrast is not None and site.asphalt is None:
            raise PatternError(
                "contrast needs the colour of the asphalt, which was not measured; give asphalt in the file of --paint "
                "(PaintLimits(asphalt=...))"
            )
        darkest = torch.full((1, 3), albedo[0])
        colours, _ = _maps(self, site, albedo, darkest.device, darkest.dtype)
        if black and float((colours(darkest) - darkest).abs().max()) > 1e-3:
            raise PatternError("only black paint is searched, but the limits on colour leave no black; let colour vary")

    def applied(self, pattern: Pattern, site: Site, *, albedo: tuple[float, float], max_share: float | None) -> Pattern:
        """A pattern that obeys the limits, near the one given; differentiable.

        Args:
            pattern: one pattern or a batch, which may break the limits.
            site: the stretch of road, checked by `check`.
            albedo: lowest and highest value of a colour channel in the search space.
            max_share: largest share of the canvas that may be painted, besides `max_area_m2`; None for no such limit.
        """
        colours, clear = _maps(self, site, albedo, pattern.boxes.device, pattern.boxes.dtype)
        boxes = pattern.boxes if clear is None else clear(pattern.boxes)
        obeying = Pattern(pattern.shapes, boxes, colours(pattern.colours))
        if self.max_area_m2 is not None and site.size_m is not None:
            share = self.max_area_m2 / (site.size_m[0] * site.size_m[1])
            max_share = share if max_share is None else min(share, max_share)
        return obeying if max_share is None else shrunk(obeying, max_share)


@lru_cache(maxsize=32)
def _maps(
    limits: PaintLimits, site: Site, albedo: tuple[float, float], device: torch.device, dtype: torch.dtype
) -> tuple[AllowedColours, KeepOut | None]:
    """The maps that bring colours and boxes to allowed ones; no map of boxes without a keep-out or marks."""
    colours = allowed_colours(
        albedo=albedo,
        palette=limits.colours,
        printable=limits.printable,
        limit=limits.contrast,
        asphalt=site.asphalt,
    )
    clear = None if limits.keep_out_m is None else keep_out(site, limits.keep_out_m)
    return placed(colours, device, dtype), clear and placed(clear, device, dtype)


def shrunk(pattern: Pattern, max_share: float) -> Pattern:
    """The pattern with all widths in the same ratio, so that its figures sum to a share of the canvas at most."""
    excess = (pattern.painted_share / max_share * (1 + 1e-6)).clamp_min(1.0)
    x, y, width, length, rotation_deg = pattern.boxes.unbind(-1)
    boxes = torch.stack([x, y, width / excess[..., None], length, rotation_deg], -1)
    return Pattern(pattern.shapes, boxes, pattern.colours)


def area_m2(pattern: Pattern, size_m: tuple[float, float]) -> Float[Tensor, "*b"]:
    """The sum of the figures' areas; what lies over another figure or beyond the canvas counts too."""
    return pattern.painted_share * (size_m[0] * size_m[1])
