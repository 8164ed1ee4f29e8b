"""What a check leaves for others to read: JUnit XML for a CI, Markdown for people."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from roadproof.gate.result import Case, CheckResult
from roadproof.gate.verdict import Kind, Status, digits_apart
from roadproof.io.files import printable, write_atomically, write_text
from roadproof.recordings import evenly
from roadproof.report.formatting import MISSING, in_words, markdown_text

WORST = "worst.jpg"
SHOWN_PX, BLACK = 1500, 12
WORST_COLUMNS = 6
COLUMNS = ("scenario", "paint", "drives", "deviation m", "went wrong", "verdict")

LEGEND = (
    "Deviation is a median, and went wrong the share of drives that left their lane or did not arrive, with 95 % "
    "intervals."
)


def rows_of(result: CheckResult) -> tuple[tuple[str, ...], ...]:
    """The table: a row a case, under `COLUMNS`."""
    return tuple(
        (
            f"{case.scenario}, {in_words(case.weather)}",
            case.name,
            str(len(case.drives)),
            _cell(case, "deviation_m"),
            _cell(case, "left_lane" if "left_lane" in case.measures else "failed"),
            str(case.status),
        )
        for case in result.cases
    )


def _cell(case: Case, measure: str) -> str:
    if (found := case.measures.get(measure)) is None:
        return MISSING
    scale, ends = (1, ()) if measure == "deviation_m" else (100, (0.0, 1.0))
    # 1 of 300 drives is more than none.
    digits = digits_apart(measure, found.value, *ends)
    told = [f"{scale * each:.{digits}f}" for each in (found.value, found.low, found.high) if each is not None]
    percent = "%" if scale == 100 else ""
    return f"{told[0]}{percent} ({'–'.join(told[1:])})" if len(told) > 1 else f"{told[0]}{percent}"


def why(case: Case) -> tuple[str, ...]:
    """Why a case does not pass."""
    wrong = [each for each in case.drives if each.wrong]
    told = [f"{len(wrong)} of {len(case.drives)} drives go wrong, the first: {wrong[0].wrong}"] if wrong else []
    return *case.reasons, *told


def heading(result: CheckResult) -> str:
    """The verdict in one line."""
    drives = len({name for case in result.cases for each in case.drives for name in (each.clean, each.painted) if name})
    where = "predicted in recordings, nothing was driven for real" if result.predicted else "driven in the simulator"
    passed = f"{len(result.cases) - len(result.not_passed)} of {len(result.cases)} cases passed"
    beside = "compared with the reference" if result.compared else "no reference"
    return f"{result.status}: {passed}; {result.controller}, {result.budget}, {drives} drives, {where}, {beside}"


def write_junit(result: CheckResult, seconds: float, path: Path) -> None:
    """Write JUnit XML: a test case for each case, with a failure that says why it does not pass.

    Args:
        result: the result of the check.
        seconds: how long the check took; each case's time is its drives' share of it.
        path: the XML file to write.

    Raises:
        OutputError: the file cannot be written.
    """
    counts = {"tests": str(len(result.cases)), "failures": str(len(result.not_passed)), "errors": "0"}
    counts["time"] = f"{seconds:.3f}"
    drive_s = seconds / sum(len(case.drives) for case in result.cases)
    root = ET.Element("testsuites", counts)
    suite = ET.SubElement(root, "testsuite", {"name": printable(f"roadproof check {result.controller}"), **counts})
    properties = ET.SubElement(suite, "properties")
    for name in ("roadproof", "controller", "architecture", "budget"):
        ET.SubElement(properties, "property", {"name": name, "value": printable(str(getattr(result, name)))})
    for case in result.cases:
        name = {"classname": printable(f"roadproof.{case.scenario}"), "name": printable(f"{case.weather}, {case.name}")}
        test = ET.SubElement(suite, "testcase", name, time=f"{drive_s * len(case.drives):.3f}")
        if case.status is not Status.PASSED:
            message = {"type": str(case.status), "message": printable("; ".join(case.reasons))}
            told = map(printable, (*why(case), f"see it: {case.command}"))
            ET.SubElement(test, "failure", message).text = "\n".join(told)
    ET.indent(root)
    content: bytes = ET.tostring(root, "utf-8", xml_declaration=True)
    write_atomically(path, lambda part: part.write_bytes(content + b"\n"))


def write_summary(result: CheckResult, pictured: Case | None, path: Path) -> None:
    """Write the Markdown summary.

    Args:
        result: the result of the check.
        pictured: the case that the picture `WORST`, beside the summary, shows; None where there is no picture.
        path: the Markdown file to write.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [f"## roadproof check: {_shown(heading(result))}", ""]
    lines += [_row(COLUMNS), _row(["---"] * len(COLUMNS)), *map(_row, rows_of(result))]
    lines += ["", LEGEND]
    for case in result.not_passed:
        lines += ["", f"### {_shown(f'{case.status}: {case}')}", "", *(f"- {_shown(reason)}" for reason in why(case))]
        lines += ["", "```sh", printable(case.command), "```"]
    if pictured is not None:
        # A case that passes may go further: deviations up to its limit are let pass.
        among = "Furthest astray" if pictured.status is Status.PASSED else "Furthest astray of what does not pass"
        shows = "above without paint, below with it, at the same instants"
        if pictured.kind is Kind.BARE:
            among, shows = "Not clean", "one of these drives, from its start to its end"
        about = _shown(f"{among}, {pictured}: {shows}")
        lines += ["", f"![{about}]({WORST})", "", f"*{about} (`{WORST}`).*"]
    write_text(path, "\n".join(lines) + "\n")


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(map(_shown, cells))} |"


def _shown(text: str) -> str:
    """A text with anyone's names in it, which Markdown shows as it is."""
    return markdown_text(printable(text))


def write_worst(drives: Sequence[UInt8[np.ndarray, "n h w 3"]], path: Path) -> None:
    """Write a picture of drives, one below the other, each at some of its moments.

    Args:
        drives: the camera's pictures of each drive, of one size; of all as many.
        path: the JPEG file to write.

    Raises:
        OutputError: the picture cannot be written.
    """
    moments = evenly(len(drives[0]), WORST_COLUMNS)
    whole = np.concatenate([np.concatenate(list(pictures[moments]), 1) for pictures in drives])
    # Around what was recorded, pictures of the recorded world are black.
    shown = whole.max((1, 2)) > BLACK
    picture = Image.fromarray(whole[shown] if shown.any() else whole)
    picture = picture.resize((SHOWN_PX, round(SHOWN_PX * picture.height / picture.width)))
    write_atomically(path, lambda part: picture.save(part, format="JPEG", quality=88))
