"""A small table: headings over several columns, numbers with intervals, a note. And as Markdown and LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TypeAlias

from roadproof.driving.intervals import Estimate
from roadproof.errors import StudyError
from roadproof.report.formatting import MISSING, markdown_text
from roadproof.study.statistics import EQUAL


@dataclass(frozen=True, slots=True)
class Number:
    """A number that is shown with its interval.

    Args:
        estimate: the number and both ends of its interval.
        digits: how many digits stand after the point.
        best: whether it is the best of its row.
        unit: the unit behind the number; "%" for shares, which are in [0, 1].
    """

    estimate: Estimate
    digits: int = 2
    best: bool = False
    unit: str = ""

    @property
    def value(self) -> str:
        """The number in words."""
        return self._shown(self.estimate.value) + self.unit

    @property
    def interval(self) -> tuple[str, str] | None:
        """Both ends of the interval in words."""
        if self.estimate.low is None or self.estimate.high is None:
            return None
        return self._shown(self.estimate.low), self._shown(self.estimate.high)

    def _shown(self, number: float) -> str:
        shown = f"{number * 100 if self.unit == '%' else number:.{self.digits}f}"
        # −0.00 would look like a finding.
        return shown.replace("-", "−") if float(shown) else shown.removeprefix("-")


Cell: TypeAlias = str | Number


def marked(numbers: Sequence[Estimate | None], *, compared: bool = True) -> list[Cell]:
    """Numbers, where they are compared with the highest marked; equal ones all, unless all are equal."""
    values = [number.value for number in numbers if number is not None]
    top = max(values, default=0.0)
    one = compared and min(values, default=0.0) < top - EQUAL
    return [MISSING if each is None else Number(each, best=one and each.value >= top - EQUAL) for each in numbers]


def share_of(mean: Estimate | None) -> str:
    """The mean of what is 0 or 1, in percent."""
    return MISSING if mean is None else f"{mean.value:.0%}"


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading over one or several columns."""

    text: str
    span: int = 1


def headings(*texts: str) -> tuple[Heading, ...]:
    """Headings over a column each."""
    return tuple(map(Heading, texts))


@dataclass(frozen=True, kw_only=True, slots=True)
class Table:
    """A table as people read it.

    Args:
        name: the name of the table's file without the ending, and of its label in LaTeX.
        title: what the table shows.
        note: how to read the table, and what is not in it.
        header: rows of headings, each as wide as the table.
        rows: rows of cells; an empty text continues the cell above.
        left: how many columns from the left hold names.

    Raises:
        StudyError: a row is not as wide as the others, or the name is not fit for a file.
    """

    name: str
    title: str
    note: str
    header: tuple[tuple[Heading, ...], ...]
    rows: tuple[tuple[Cell, ...], ...]
    left: int = 1

    def __post_init__(self) -> None:
        # What names a file comes from rows, and those from wherever the folder does.
        if self.name != slug(self.name):
            raise StudyError(f"table {self.name!r} cannot name a file, expected small letters, digits and dashes")
        for width in (*(sum(each.span for each in row) for row in self.header), *map(len, self.rows)):
            if width != self.columns:
                raise StudyError(f"table {self.name}: a row has {width} columns, the last heading {self.columns}")

    @property
    def columns(self) -> int:
        """How many columns the table has."""
        return sum(each.span for each in self.header[-1])

    @property
    def flat_header(self) -> tuple[str, ...]:
        """One heading a column, those above it first."""
        rows = [[heading.text for heading in row for _ in range(heading.span)] for row in self.header]
        return tuple(": ".join(filter(None, stack)) for stack in zip(*rows, strict=True))


def slug(text: str) -> str:
    """A text as part of a file name."""
    return re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-") or "method"


def in_markdown(table: Table) -> str:
    """The table with its title and note; the best of a row in bold, names escaped."""
    marks = ["---"] * table.left + ["---:"] * (table.columns - table.left)
    lines = [
        _markdown_row([markdown_text(text) for text in table.flat_header]),
        _markdown_row(marks),
        *(_markdown_row([_markdown_cell(cell) for cell in row]) for row in table.rows),
    ]
    return f"### {markdown_text(table.title)}\n\n" + "\n".join(lines) + f"\n\n{markdown_text(table.note)}\n"


def in_latex(table: Table) -> str:
    """The table for a paper, with booktabs; interval ends stand as sub- and superscript, the best of a row in bold."""
    lines = [
        "% needs \\usepackage{booktabs}",
        "\\begin{table*}",
        "\\centering",
        f"\\begin{{tabular}}{{{'l' * table.left + 'c' * (table.columns - table.left)}}}",
        "\\toprule",
    ]
    for depth, row in enumerate(table.header):
        lines.append(" & ".join(_latex_heading(heading) for heading in row) + r" \\")
        if depth < len(table.header) - 1:
            lines += _rules(row)
    lines += ["\\midrule", *(" & ".join(map(_latex_cell, row)) + r" \\" for row in table.rows), "\\bottomrule"]
    caption = f"{latex_text(table.title)}. {latex_text(table.note)}"
    return "\n".join(
        [*lines, "\\end{tabular}", f"\\caption{{{caption}}}", f"\\label{{T:{table.name}}}", "\\end{table*}", ""]
    )


_LATEX = str.maketrans({
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "#": r"\#", "_": r"\_", "%": r"\%",
    "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "<": r"\textless{}", ">": r"\textgreater{}",
    "|": r"\textbar{}", "≥": r"$\geq$", "×": r"$\times$", "±": r"$\pm$", "−": "$-$", "–": "--", "’": "'",
    "…": r"\ldots{}",
})  # fmt: skip


def latex_text(text: str) -> str:
    """Text that LaTeX prints as it is."""
    return " ".join(text.split()).translate(_LATEX)


def _markdown_row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _markdown_cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return markdown_text(cell)
    value = f"**{cell.value}**" if cell.best else cell.value
    return value if cell.interval is None else f"{value} ({cell.interval[0]} to {cell.interval[1]})"


def _latex_heading(heading: Heading) -> str:
    text = latex_text(heading.text)
    return text if heading.span == 1 else f"\\multicolumn{{{heading.span}}}{{c}}{{\\textbf{{{text}}}}}"


def _latex_cell(cell: Cell) -> str:
    if isinstance(cell, str):
        return latex_text(cell)
    value = latex_text(cell.value).replace("$-$", "-")
    number = f"\\mathbf{{{value}}}" if cell.best else value
    if cell.interval is None:
        return f"${number}$"
    low, high = (end.replace("−", "-") for end in cell.interval)
    return f"${number}_{{{low}}}^{{{high}}}$"


def _rules(row: tuple[Heading, ...]) -> list[str]:
    """A thin line under every heading that spans columns."""
    ends = accumulate(heading.span for heading in row)
    rules = [
        f"\\cmidrule(lr){{{end - heading.span + 1}-{end}}}"
        for heading, end in zip(row, ends, strict=True)
        if heading.span > 1
    ]
    return ["".join(rules)] if rules else []
