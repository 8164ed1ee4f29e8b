"""What a check leaves for others to read: JUnit XML for a CI, Markdown for people."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

from roadproof.gate.result import Case, CheckResult
from roadproof.gate.verdict import Status, shown
from roadproof.io.files import write_atomically
from roadproof.report.words import MISSING

WORST = "worst.jpg"
COLUMNS = ("scenario", "weather", "paint", "drives", "deviation, median", "left lane or failed", "verdict")


def rows_of(result: CheckResult) -> tuple[tuple[str, ...], ...]:
    """The table: a row a case, under `COLUMNS`."""
    return tuple(
        (
            case.scenario,
            case.weather,
            case.name,
            str(len(case.drives)),
            _cell(case, "deviation_m"),
            _cell(case, "left_lane" if "left_lane" in case.measures else "failed"),
            str(case.status),
        )
        for case in result.cases
    )


def _cell(case: Case, measure: str) -> str:
    return shown(measure, case.measures[measure]) if measure in case.measures else MISSING


def why(case: Case) -> tuple[str, ...]:
    """Why a case does not pass, and the command that shows it."""
    wrong = [each for each in case.drives if each.wrong]
    told = [f"{len(wrong)} of {len(case.drives)} drives go wrong, the first: {wrong[0].wrong}"] if wrong else []
    return (*case.reasons, *told, f"see it: {case.command}")


def heading(result: CheckResult) -> str:
    """The verdict in one line."""
    drives = len({name for case in result.cases for each in case.drives for name in (each.clean, each.painted)})
    where = "predicted in recordings, nothing was driven for real" if result.predicted else "driven in the simulator"
    passed = f"{len(result.of(Status.PASSED))} of {len(result.cases)} cases passed"
    beside = "compared with the reference" if result.compared else "no reference"
    return f"{result.status}: {passed}; {result.controller}, {result.budget}, {drives} drives, {where}, {beside}"


def write_junit(result: CheckResult, path: Path) -> None:
    """Write JUnit XML: a test case for each case, with a failure that says why it does not pass.

    Raises:
        OutputError: it cannot be written.
    """
    counts = {"tests": str(len(result.cases)), "failures": str(len(result.cases) - len(result.of(Status.PASSED)))}
    root = ET.Element("testsuites", counts)
    suite = ET.SubElement(root, "testsuite", {"name": f"roadproof check {result.controller}", "errors": "0", **counts})
    told = ET.SubElement(suite, "properties")
    for name in ("roadproof", "controller", "architecture", "budget"):
        ET.SubElement(told, "property", {"name": name, "value": str(getattr(result, name))})
    for case in result.cases:
        name = {"classname": f"roadproof.{case.scenario}", "name": f"{case.weather}, {case.name}"}
        test = ET.SubElement(suite, "testcase", name)
        if case.status is not Status.PASSED:
            message = {"type": str(case.status), "message": "; ".join(case.reasons)}
            ET.SubElement(test, "failure", message).text = "\n".join(why(case))
    ET.indent(root)
    content: bytes = ET.tostring(root, "utf-8", xml_declaration=True)
    write_atomically(path, lambda part: part.write_bytes(content + b"\n"))


def write_summary(result: CheckResult, pictured: Case | None, path: Path) -> None:
    """Write the Markdown summary.

    Args:
        result: of the check.
        pictured: the case that `WORST` beside it shows; None where there is no picture.
        path: of the file.

    Raises:
        OutputError: it cannot be written.
    """
    lines = [f"## roadproof check: {heading(result)}", ""]
    lines += [_row(COLUMNS), _row(["---"] * len(COLUMNS)), *map(_row, rows_of(result))]
    lines += ["", "Values are medians and shares of drives, with their 95 % intervals."]
    for case in result.cases:
        if case.status is not Status.PASSED:
            *reasons, command = why(case)
            lines += ["", f"### {case.status}: {case}", "", *(f"- {reason}" for reason in reasons)]
            lines += ["", "```sh", command.removeprefix("see it: "), "```"]
    if pictured is not None:
        about = f"the drive that went furthest astray, {pictured}; left without paint, right with it"
        lines += ["", f"![{about}]({WORST})", "", f"*{about[0].upper()}{about[1:]}: `{WORST}`.*"]
    write_atomically(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


def _row(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
