"""Where an attack looks: patterns as points of the unit cube, with their bounds.

Every parameter is stored as a share of its range, in [0, 1], as the paper's authors do; one step of the optimiser then
means the same in every direction.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Literal, cast, get_args

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from roadproof.constants import constant
from roadproof.coverage import Shape
from roadproof.errors import PatternError
from roadproof.geometry import CANVAS_SIZE_PX
from roadproof.io.records import plain
from roadproof.limits import MAX_FIGURES, is_whole
from roadproof.paint.limits import PaintLimits, shrunk
from roadproof.paint.site import Site
from roadproof.patterns import Pattern, boxes_from_published, published_from_boxes

Family = Literal["published", "published-canvas-centre", "published-bo", "free"]
FAMILIES: tuple[Family, ...] = get_args(Family)


@dataclass(frozen=True, slots=True)
class _Parameter:
    name: str
    low: float
    high: float
    start_low: float  # random starts are uniform in [start_low, high]


_PUBLISHED = (
    _Parameter("rotation_deg", 0.0, 180.0, 20.0),
    _Parameter("position_px", 0.0, 380.0, 0.0),
    _Parameter("width_px", 0.0, 100.0, 20.0),
    _Parameter("inset_px", 0.0, 70.0, 0.0),
)
_PUBLISHED_BO = (
    _Parameter("rotation_deg", 0.0, 180.0, 0.0),
    _Parameter("position_px", 0.0, 400.0, 0.0),
    _Parameter("width_px", 0.0, 100.0, 0.0),
    _Parameter("inset_px", 0.0, 70.0, 0.0),
)
_PUBLISHED_BO_ALONE = (
    *_PUBLISHED_BO[:2],
    _Parameter("width_px", 0.0, 80.0, 0.0),
    _Parameter("inset_px", 0.0, 60.0, 0.0),
)
_FREE = (
    _Parameter("x_px", 0.0, float(CANVAS_SIZE_PX), 0.0),
    _Parameter("y_px", 0.0, float(CANVAS_SIZE_PX), 0.0),
    _Parameter("width_px", 5.0, 105.0, 25.0),
    _Parameter("length_px", 20.0, 390.0, 20.0),
    _Parameter("rotation_deg", 0.0, 180.0, 0.0),
)
_HALF_TURN = (1.0, 1.0, 1.0, 1.0, 0.5)
PUBLISHED_BO_LEVELS = 250.0
"""Where colours end in the authors' Bayesian optimisation, of 255 levels."""
_COLOUR_NAMES = ("red", "green", "blue")


@dataclass(frozen=True, kw_only=True, slots=True)
class SearchSpace:
    """All patterns of K figures that an attack may paint.

    Args:
        figures: number K of figures.
        family: "published", the paper's rectangles centred along the road, rotated about themselves as in the
            released code (4 parameters); "published-canvas-centre", rotated about the canvas' centre as in the text;
            "published-bo", the same rectangles in the bounds of the authors' Bayesian optimisation, which depend on K,
            and colours up to 250 of 255 levels;
            "free", any centre on the canvas (5 parameters).
        shape: shape of every figure; the published families are rectangles.
        colour: whether the paint's colour is searched (three parameters more); otherwise all figures are black.
        albedo: lowest and highest value of a colour channel, in [0, 1]; real paint reaches neither end.
        max_painted_share: largest share of the canvas that the figures' areas may sum to, for which widths shrink
            together; None for no limit.
        limits: limits on paint, in metres and colours; None limits nothing.
        site: stretch of road to which the limits apply; `on` sets it.

    Raises:
        PatternError: a field is out of its range, or two fields do not fit each other.
    """

    figures: int
    family: Family = "published"
    shape: Shape = Shape.RECTANGLE
    colour: bool = True
    albedo: tuple[float, float] = (0.0, 1.0)
    max_painted_share: float | None = None
    limits: PaintLimits | None = None
    site: Site | None = None

    def __post_init__(self) -> None:
        if not is_whole(self.figures) or not 1 <= self.figures <= MAX_FIGURES:
            raise PatternError(f"number of figures is {self.figures}, expected 1 to {MAX_FIGURES}")
        if self.family not in FAMILIES:
            raise PatternError(f"family is {self.family!r:.40}, expected one of {', '.join(FAMILIES)}")
        if type(self.shape) is not Shape:
            raise PatternError(
                f"shape is {self.shape!r:.40}, expected one of {', '.join(map(str, list(Shape)))} as a Shape"
            )
        if self.family != "free" and self.shape is not Shape.RECTANGLE:
            raise PatternError(f"the {self.family} family has rectangles only; use the free family for a {self.shape}")
        match self.albedo:
            case (float() | int() as low, float() | int() as high) if (
                type(self.albedo) is tuple and 0 <= low < high <= 1
            ):
                pass
            case _:
                raise PatternError(
                    f"albedo is {self.albedo!r:.80}, expected a tuple of two numbers, 0 ≤ lowest < highest ≤ 1"
                )
        if self.family == "published-bo":
            self._end_as_published()
        if self.max_painted_share is not None and not 0.0 < self.max_painted_share <= 1.0:
            raise PatternError(f"max_painted_share is {self.max_painted_share}, expected a value in (0, 1]")

    def _end_as_published(self) -> None:
        brightest = PUBLISHED_BO_LEVELS / 255
        if self.albedo[0] >= brightest:
            raise PatternError(
                f"albedo begins at {self.albedo[0]}, expected less than {brightest:.3f}, where colours of the "
                f"{self.family} family end"
            )
        object.__setattr__(self, "albedo", (self.albedo[0], min(self.albedo[1], brightest)))

    def __repr__(self) -> str:
        # Runs and running searches are known by it; what limits nothing is not named, as before there were limits.
        names = [each.name for each in fields(self) if each.name not in ("limits", "site")]
        names += [name for name in ("limits", "site") if getattr(self, name) is not None]
        return f"SearchSpace({', '.join(f'{name}={getattr(self, name)!r}' for name in names)})"

    def on(self, site: Site) -> SearchSpace:
        """The space with its limits applied to a stretch of road; a space without limits is unchanged.

        Raises:
            PatternError: the limits leave no pattern there, or need something of the road that is not known.
        """
        if self.limits is None:
            return self
        known = self.limits.site(site)
        self.limits.check(known, albedo=self.albedo, black=not self.colour)
        return replace(self, site=known)

    def require_paint(self, site: Site) -> None:
        """See that the limits leave patterns on a stretch of road whose asphalt is not measured yet.

        Raises:
            PatternError: as `on` does.
        """
        if self.limits is not None:
            known = self.limits.site(site)
            self.limits.check(known, albedo=self.albedo, black=not self.colour, measured=False)

    @property
    def is_limited(self) -> bool:
        """Whether area or paint is limited, so that a pattern may be another than that of the point's parameters."""
        return self.limits is not None or self.max_painted_share is not None

    @property
    def unlimited(self) -> SearchSpace:
        """The space without its limits."""
        return replace(self, limits=None, site=None)

    @property
    def stated(self) -> dict[str, Any]:
        """The fields that identify the space, for files; limits are named only if there are any."""
        told = cast("dict[str, Any]", plain(replace(self, site=None)))
        return {name: value for name, value in told.items() if value is not None or name not in ("limits", "site")}

    @property
    def _shape_parameters(self) -> tuple[_Parameter, ...]:
        if self.family == "published-bo":
            return _PUBLISHED_BO_ALONE if self.figures == 1 else _PUBLISHED_BO
        return _FREE if self.family == "free" else _PUBLISHED

    @property
    def names(self) -> tuple[str, ...]:
        """Names of one figure's parameters, in order."""
        return tuple(p.name for p in self._shape_parameters) + (_COLOUR_NAMES if self.colour else ())

    @property
    def shape_ranges(self) -> tuple[float, ...]:
        """Highest minus lowest value of each shape parameter, in px or degrees."""
        return tuple(p.high - p.low for p in self._shape_parameters)

    def random(self, batch: tuple[int, ...], generator: torch.Generator) -> Float[Tensor, "*b k n"]:
        """Points drawn as the authors draw their starts: uniform, but no slivers and (published) no rotation below 20°.

        Drawn on the CPU, so that the same seed gives the same starts on every device.
        """
        unit = torch.rand(*batch, self.figures, len(self.names), generator=generator)
        start_low = [(p.start_low - p.low) / (p.high - p.low) for p in self._shape_parameters]
        low = torch.tensor(start_low + [0.0] * (len(self.names) - len(start_low)))
        return low + (1 - low) * unit

    def drawn(self, count: int, seed: int) -> Pattern:
        """A batch of random patterns, the same for the same seed."""
        return self.pattern(self.random((count,), torch.Generator().manual_seed(seed)))

    def project(self, unit: Float[Tensor, "*b k n"]) -> Float[Tensor, "*b k n"]:
        """The nearest point inside the bounds: clipped, but a free rotation wraps round: both its ends are the same."""
        clipped = unit.clamp(0.0, 1.0)
        if self.family != "free":
            return clipped
        return torch.cat([clipped[..., :4], unit[..., 4:5] % 1.0, clipped[..., 5:]], -1)

    def pattern(self, unit: Float[Tensor, "*b k n"]) -> Pattern:
        """The pattern at a point of the space, differentiable in it."""
        parameters = self._shape_parameters
        low = constant(tuple(p.low for p in parameters), unit)
        natural = low + unit[..., : len(parameters)] * constant(self.shape_ranges, unit)
        boxes = natural if self.family == "free" else boxes_from_published(natural, rotate_about=self._rotate_about)
        if self.shape is Shape.TRIANGLE:
            # A triangle looks the same only after a full turn.
            boxes = boxes / constant(_HALF_TURN, boxes)
        darkest, brightest = self.albedo
        shares = unit[..., len(parameters) :] if self.colour else torch.zeros_like(unit[..., :3])
        pattern = Pattern((self.shape,) * self.figures, boxes, darkest + shares * (brightest - darkest))
        if self.limits is not None:
            if self.site is None:
                raise PatternError("limits on paint hold on a stretch of road; say which, by space.on(site)")
            return self.limits.applied(pattern, self.site, albedo=self.albedo, max_share=self.max_painted_share)
        return pattern if self.max_painted_share is None else shrunk(pattern, self.max_painted_share)

    def point(self, pattern: Pattern) -> Float[Tensor, "*b k n"]:
        """The point of a pattern; the nearest point if the pattern is outside of the space.

        What limits on area and paint did is not undone: a pattern that they changed may have no point near it.

        Raises:
            PatternError: the pattern has other figures than this space.
        """
        if pattern.shapes != (self.shape,) * self.figures:
            names = ", ".join(pattern.shapes)
            raise PatternError(f"the pattern is {names}; expected {self.figures} of shape {self.shape}")
        parameters = self._shape_parameters
        boxes = pattern.boxes
        if self.shape is Shape.TRIANGLE:
            boxes = boxes * boxes.new_tensor(_HALF_TURN)
        else:
            boxes = torch.cat([boxes[..., :4], boxes[..., 4:].remainder(180.0)], -1)
        natural = boxes if self.family == "free" else published_from_boxes(boxes, rotate_about=self._rotate_about)
        low = natural.new_tensor([p.low for p in parameters])
        unit = (natural - low) / natural.new_tensor(self.shape_ranges)
        darkest, brightest = self.albedo
        colours = (pattern.colours - darkest) / (brightest - darkest)
        return self.project(torch.cat([unit, colours], -1) if self.colour else unit)

    @property
    def _rotate_about(self) -> Literal["figure", "canvas"]:
        return "canvas" if self.family == "published-canvas-centre" else "figure"


def derived_seed(seed: int, number: int) -> int:
    """A seed for the n-th of several draws of one search, as unlike the others as seeds are."""
    return int(np.random.SeedSequence((seed, number)).generate_state(1)[0])
