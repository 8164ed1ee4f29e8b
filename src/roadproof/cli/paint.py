"""Options on paint that every searching verb shares: limits, and what the search takes the mean over."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from roadproof.cli.options import number, unset
from roadproof.limits import LEAST_PAINT_M2, MOST_PAINT_M2

if TYPE_CHECKING:
    from roadproof.compositing import Variation
    from roadproof.paint import PaintLimits

GROUP = "Paint that could be real"


@dataclass(frozen=True, slots=True)
class Paint:
    """What the options on paint say.

    Args:
        limits: limits on paint; None where nothing is limited.
        variation: what the search takes the mean over; None for paint and camera as recorded.
    """

    limits: PaintLimits | None
    variation: Variation | None


def _grouped(option: Any) -> Any:  # noqa: ANN401
    option.rich_help_panel = GROUP
    return option


OPTIONS: dict[str, Any] = {
    "max_area": Annotated[
        float | None, _grouped(number("Largest area of paint, m².", LEAST_PAINT_M2, MOST_PAINT_M2, default=False))
    ],
    "colours": Annotated[str | None, _grouped(unset("The only paints there are, as #dededa, with commas between."))],
    "printable": Annotated[bool, _grouped(typer.Option("--printable", help="Only colours that offset print can mix."))],
    "contrast": Annotated[
        tuple[float, float] | None, _grouped(unset("Least and most contrast to the asphalt; 0 none, 1 black on white."))
    ],
    "keep_out": Annotated[
        float | None, _grouped(number("Least distance from lane marks, m.", 0.0, 10.0, default=False))
    ],
    "robust": Annotated[
        bool,
        _grouped(typer.Option("--robust", help="Search the mean over camera noise, light, blur, placement and wear.")),
    ],
    "paint": Annotated[
        Path | None, _grouped(unset("TOML file with the same in tables named paint and variation; options win."))
    ],
}
"""The options that `verb` gives a function with a parameter `paint`, by name, with their annotations."""

_FIELDS = {"max_area": "max_area_m2", "keep_out": "keep_out_m"}
"""The fields of `PaintLimits` that are not called as their options are."""


def with_paint(given: Mapping[str, Any]) -> dict[str, Any]:
    """What a verb was given, with what the options on paint say as one argument, `paint`."""
    own = {name: value for name, value in given.items() if name not in OPTIONS}
    return own | {"paint": _paint({name: given[name] for name in OPTIONS})}


def _paint(asked: Mapping[str, Any]) -> Paint:
    """The limits and the variation of the options, by their names in `OPTIONS`, and of the file."""
    given = {name: value for name, value in asked.items() if value is not None and value is not False}
    if not given:
        # Torch takes seconds to import; commands without limits read their other options first.
        return Paint(None, None)
    from roadproof.compositing import Variation
    from roadproof.paint import PaintLimits

    limits, variation = _read(given["paint"]) if "paint" in given else (None, None)
    said = {_FIELDS.get(name, name): value for name, value in given.items() if name not in ("robust", "paint")}
    if "colours" in said:
        said["colours"] = tuple(each.strip() for each in said["colours"].split(","))
    if said:
        limits = replace(limits or PaintLimits(), **said)
    return Paint(limits, Variation() if "robust" in given else variation)


def _read(path: Path) -> tuple[PaintLimits | None, Variation | None]:
    """Limits on paint and a variation from the tables [paint] and [variation], each None where it is not there."""
    from roadproof.compositing import Variation
    from roadproof.errors import PatternError
    from roadproof.io.tables import build
    from roadproof.io.text import read_toml
    from roadproof.paint import PaintLimits

    content = read_toml(path, PatternError)
    for key, table in content.items():
        if key not in ("paint", "variation") or not isinstance(table, dict):
            raise PatternError(f"{path}: {key!r:.60} is no table of it, expected [paint] and [variation]")
    limits, variation = content.get("paint"), content.get("variation")
    return (
        None if limits is None else build(PaintLimits, limits, f"{path}: [paint]", PatternError),
        None if variation is None else build(Variation, variation, f"{path}: [variation]", PatternError),
    )
