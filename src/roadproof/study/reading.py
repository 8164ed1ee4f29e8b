"""What the plans of studies and checks have in common: their tables on paint, and whom they may trust."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from roadproof.compositing import Variation
from roadproof.controllers.loading import runs_code
from roadproof.errors import StudyError
from roadproof.io.tables import build
from roadproof.paint import PaintLimits
from roadproof.simulators.loading import is_elsewhere


def paint_of(content: Mapping[str, Any], what: str) -> tuple[PaintLimits | None, Variation | None]:
    """Limits on paint and a variation from the tables [paint] and [variation], each None where it is not there.

    Raises:
        StudyError: there is another key, or a value makes no sense.
    """
    for key, table in content.items():
        if key not in ("paint", "variation") or not isinstance(table, dict):
            raise StudyError(f"{what}: {key!r:.60} is no table of it, expected [paint] and [variation]")
    limits, variation = content.get("paint"), content.get("variation")
    return (
        None if limits is None else build(PaintLimits, limits, "paint", StudyError),
        None if variation is None else build(Variation, variation, "variation", StudyError),
    )


def refuse_untrusted(controller: str, simulator: str | None) -> None:
    """See that following a plan of anyone's runs none of their code and calls no other machine.

    Args:
        controller: the spec of the controller that the plan names.
        simulator: the spec of its simulator; None where it opens none.

    Raises:
        StudyError: it would; the message names what it would do, and how to allow that.
    """
    if runs_code(controller):
        raise StudyError(
            f"controller {controller!r} runs what its author wrote; look at it, then give --trust (trust=True)"
        )
    if simulator is not None and is_elsewhere(simulator):
        raise StudyError(f"simulator {simulator!r} is another machine; give --trust (trust=True) to call it")
