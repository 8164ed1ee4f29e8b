"""The page of a hardening: verdict, every kind of attack before and after, the bare road, round by round."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from roadproof.hardening.judgement import JudgedAttack
from roadproof.hardening.result import Hardened
from roadproof.io.files import write_text
from roadproof.io.html import encoded
from roadproof.patterns import load_pattern, raster
from roadproof.report.charts import by_round
from roadproof.report.html import rendered

_BADGES = {"helped": "holds", "not shown": "unclear", "did not help": "fails"}


def write_hardening(found: Hardened, folder: Path) -> Path:
    """Write hardening.html beside what `harden` left; it needs no other file.

    Returns:
        The path of the page.

    Raises:
        PatternError: a pattern of the judgement is missing or damaged.
        OutputError: the page cannot be written.
    """
    judged = () if found.judgement is None else found.judgement.judged
    verdict = None if found.judgement is None else found.judgement.verdict()
    text = rendered(
        "hardening.html.jinja",
        found=found,
        verdict=verdict,
        badge="" if verdict is None else _BADGES[verdict.outcome],
        pairs=_pairs(judged),
        curve=by_round([each.deviation_m for each in found.rounds]),
        patterns=[
            {
                "name": name,
                "before": _picture(folder / "round-0" / "judged" / name),
                "after": _picture(folder / f"round-{found.best}" / "judged" / name),
            }
            for name in dict.fromkeys(each.scenario for each in judged if each.after)
        ],
    )
    page = folder / "hardening.html"
    write_text(page, text)
    return page


def _pairs(judged: tuple[JudgedAttack, ...]) -> list[tuple[str, str, JudgedAttack | None, JudgedAttack | None]]:
    """Street by street, kind by kind: before and after, where there are both."""
    by = {(each.scenario, each.kind, each.after): each for each in judged}
    rows = dict.fromkeys((each.scenario, each.kind) for each in judged)
    return [(*row, by.get((*row, False)), by.get((*row, True))) for row in sorted(rows, key=lambda row: row[0])]


def _picture(folder: Path) -> str:
    return encoded(Image.fromarray(raster(load_pattern(folder / "pattern.json"))), "PNG")
