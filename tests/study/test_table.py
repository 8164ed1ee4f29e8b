import re

import pytest

from roadproof.driving.intervals import Estimate
from roadproof.errors import StudyError
from roadproof.report.formatting import markdown_text
from roadproof.study.table import Heading, Number, Table, in_latex, in_markdown, latex_text

HOSTILE = "<b>_BO_ 100% $x^2$ {a} \\end{table} #1 & ~ | `c` *d* [e](f)"


def table(name="overall", text=HOSTILE):
    return Table(
        name=name,
        title=text,
        note=f"note of {text}",
        header=((Heading(""), Heading(text, 2)), (Heading("K"), Heading("a"), Heading("% ≥"))),
        rows=(
            ("1", Number(Estimate(-1.234, -2.0, 0.5, 3), best=True), "82%"),
            (text, Number(Estimate(-0.001, None, None, 1)), Number(Estimate(0.5, 0.25, 1.0, 4), 0, unit="%")),
        ),
    )


def test_a_table_is_as_wide_everywhere():
    with pytest.raises(StudyError, match="a row has 2 columns, the last heading 1"):
        Table(name="x", title="", note="", header=((Heading("K"),),), rows=(("1", "2"),))


def test_nothing_that_is_shown_looks_like_less_than_nothing():
    assert Number(Estimate(-0.001, -0.004, 0.1, 2)).value == "0.00"
    assert Number(Estimate(-0.25, -1.0, 0.1, 2)).value == "−0.25"


def test_latex_is_balanced_and_escaped():
    written = in_latex(table())
    bare = re.sub(r"\\[{}$&%#_]", "", written)
    assert bare.count("{") == bare.count("}")
    assert bare.count("$") % 2 == 0
    assert written.count("\\begin{") == written.count("\\end{") == 2
    assert not re.search(r"(?<!\\)[#]", written)
    # Outside mathematics and commands no sign of LaTeX's is left as it is.
    words = re.sub(r"\$[^$]*\$", "", bare.split("\n", 1)[1])
    assert "_" not in words
    assert "^" not in words
    assert "%" not in words
    assert "≥" not in written
    assert [line.count("&") for line in bare.splitlines() if line.endswith(r"\\")] == [1, 2, 2, 2]
    assert r"$\mathbf{-1.23}_{-2.00}^{0.50}$" in written
    assert r"$50\%_{25}^{100}$" in written
    assert r"\cmidrule(lr){2-3}" in written


def test_latex_keeps_every_word():
    assert latex_text("a_b < c%") == r"a\_b \textless{} c\%"


def test_markdown_is_a_table_that_hides_no_html():
    written = in_markdown(table())
    lines = [line for line in written.splitlines() if line.startswith("|")]
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines}) == 1
    assert "<b>" not in written
    assert "**−1.23** (−2.00 to 0.50)" in written
    assert lines[1] == "| --- | ---: | ---: |"


def test_markdown_text_is_one_line():
    assert markdown_text("a\n| b") == r"a \| b"
