"""Draw what each part brings, scenario by scenario, from the rows of `studies/closed_loop.py`.

python studies/closed_loop_figure.py docs/results/closed_loop.json docs/results/closed_loop-cil.json --out FIGURE.png
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from roadproof.io.files import write_atomically
from roadproof.study.charts import COLOURS, MARKERS, MUTED, RULE

WAYS = {
    "random": "two\nrandom",
    "T=1": "T = 1",
    "T=3 published": "T = 3,\ndegrees",
    "T=3 metres": "T = 3,\nmetres",
    "+ driven": "best\ndriven",
    "+ rounds": "and a\nround",
}
"""The study's ways that more than one controller was attacked in, and their words."""


def draw(axes: Axes, controller: str, rows: list[dict[str, Any]], scenarios: list[str]) -> None:
    """One controller: a line for each scenario, a stroke from seed to seed, and a bar for the mean."""
    for number, scenario in enumerate(scenarios):
        here = [row for row in rows if row["scenario"] == scenario]
        got = {way: [row["deviation_m"] for row in here if row["method"] == way] for way in WAYS}
        at = [index for index, way in enumerate(WAYS) if got[way]]
        values = [values for values in got.values() if values]
        colour = COLOURS[number % len(COLOURS)]
        marker = MARKERS[number % len(MARKERS)]
        means = [np.mean(each) for each in values]
        axes.plot(at, means, color=colour, marker=marker, markersize=5, linewidth=0.9, alpha=0.85, label=scenario)
        axes.vlines(at, [min(each) for each in values], [max(each) for each in values], color=colour, alpha=0.5)
    for index, way in enumerate(WAYS):
        mean = np.mean([row["deviation_m"] for row in rows if row["method"] == way])
        axes.plot([index - 0.3, index + 0.3], [mean, mean], color="black", linewidth=2.2, zorder=3)
    seeds = len({row["seed"] for row in rows})
    axes.set_title(controller if seeds == 1 else f"{controller}, {seeds} seeds", fontsize=11)
    axes.set_xticks(range(len(WAYS)), list(WAYS.values()), fontsize=7.5)
    axes.grid(axis="y", color=RULE)
    axes.tick_params(colors=MUTED)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def main() -> None:
    """Read, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="+", type=Path)
    parser.add_argument("--out", required=True, type=Path)
    arguments = parser.parse_args()
    rows = [row for path in arguments.rows for row in json.loads(path.read_text(encoding="utf-8"))["rows"]]
    controllers, scenarios = (list(dict.fromkeys(row[key] for row in rows)) for key in ("controller", "scenario"))
    figure = Figure(figsize=(3.4 * len(controllers), 3.8), layout="constrained")
    drawn = figure.subplots(1, len(controllers), sharey=True, squeeze=False)[0]
    for axes, controller in zip(drawn, controllers, strict=True):
        draw(axes, controller, [row for row in rows if row["controller"] == controller], scenarios)
    drawn[0].set_ylabel("deviation, driven, m")
    drawn[0].set_ylim(bottom=0)
    lines, names = drawn[0].get_legend_handles_labels()
    figure.legend(lines, names, ncols=len(scenarios), loc="outside lower center", frameon=False)
    write_atomically(arguments.out, lambda part: figure.savefig(part, format="png", dpi=110))


if __name__ == "__main__":
    main()
