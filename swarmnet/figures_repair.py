"""Figures of repair: contacts against what they cost, and a repair round by round."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from swarm_mjcf.errors import SwarmError
from swarmnet.figures import MODEL, NARROW, STYLE, FigureFile, blank_figure, svg
from swarmnet.results import write_whole
from swarmnet.sheets import STYLE as PAPER

WIDE = 4.0
"""Ratio of the largest to the smallest cost from which on its axis is logarithmic."""
FLOOR = 0.002
"""Contact steps [%] drawn for none at all: the axis is logarithmic."""


def pareto(
    points: Sequence[tuple[str, Mapping[str, Any]]], contacts: str, costs: Sequence[str], *, note: str = ""
) -> Figure:
    """Contacts (log) over each of the costs; a colour for each name, a point for each of its `(name, values)`.

    Points without a cost's value are left out of its panel: a filter has no prediction error.
    """
    names = list(dict.fromkeys(name for name, _ in points))
    lines = wrap(note, 55 * len(costs))
    with mpl.rc_context(PAPER):
        figure = blank_figure(3.5 * len(costs), 3.4 + 0.1 * len(lines))
        colours = dict(zip(names, mpl.colormaps["tab10"](np.arange(len(names)) % 10), strict=True))
        markers = {name: "oD^"[number // 10 % 3] for number, name in enumerate(names)}  # there are ten colours
        first = None
        for column, cost in enumerate(costs):
            first = ax = figure.add_subplot(1, len(costs), column + 1, sharey=first)
            for name in names:
                pairs = [(v[cost], v[contacts]) for n, v in points if n == name and _there(v, cost, contacts)]
                if pairs:
                    x, y = np.array(pairs).T
                    ax.plot(x, np.maximum(y, FLOOR), markers[name], ms=4, color=colours[name], gid=name, clip_on=False)
            ax.set(xlabel=cost, ylabel=contacts if column == 0 else "", yscale="log")
            ax.label_outer(remove_inner_ticks=False)
            reached = [v[cost] for _, v in points if _there(v, cost, contacts)]
            if reached and min(reached) > 0 and max(reached) > WIDE * min(reached):
                ax.set_xscale("log")
            if " / " in cost:
                ax.axvline(1, color="0.7", lw=0.8, zorder=0)
        handles = [Line2D([], [], marker=markers[n], ls="", ms=4, color=colours[n], label=n) for n in names]
        figure.legend(handles=handles, loc="outside upper center", ncols=min(len(names), 5), frameon=False)
        if lines:
            below = (0.1 * len(lines) + 0.05) / figure.get_figheight()
            figure.get_layout_engine().set(rect=(0, below, 1, 1 - below))  # type: ignore[union-attr]
            figure.text(0.01, 0.01, "\n".join(lines), fontsize=6, va="bottom", color="0.35")
    return figure


def _there(values: Mapping[str, Any], *names: str) -> bool:
    return all(values.get(name) is not None and np.isfinite(values[name]) for name in names)


def repair_rounds(rounds: Sequence[Mapping[str, Any]]) -> Figure:
    """Contact steps and avoidable violations of the constraint, in the fresh scenes of each round [%]."""
    with mpl.rc_context(STYLE):
        figure = blank_figure(NARROW, 3.2)
        ax = figure.add_subplot()
        numbers = [row["round"] for row in rounds]
        for key, label, style in (
            ("contact_steps", "control steps with a contact", "-o"),
            ("avoidable", "decisions that break the constraint without need", "--s"),
        ):
            ax.plot(numbers, [max(100 * row[key], FLOOR) for row in rounds], style, ms=4, color=MODEL, label=label)
        polished = [row["round"] for row in rounds if row.get("polished")]
        for number in polished:
            ax.axvline(number, color="0.8", lw=1, zorder=0)
            ax.annotate(
                "quadratic programs", (number, 1), xycoords=("data", "axes fraction"), xytext=(0, 3), fontsize=9,
                textcoords="offset points", ha="right",
            )  # fmt: skip
        ax.set(xlabel="round (scenes of its own, not learned from before)", ylabel="share [%]", yscale="log")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.legend(loc="outside upper left")
    return figure


def make_repair_figures(run: str | Path) -> list[FigureFile]:
    """Writes RUN/figures/repair_rounds.svg, where the folder holds a repair. Raises SwarmError for a damaged file."""
    path = Path(run) / "repair.json"
    if not path.exists():
        return []
    try:
        rounds = json.loads(path.read_text())["rounds"]
    except (ValueError, KeyError, TypeError) as error:
        raise SwarmError(f"{path}: is damaged; `swarmnet repair` writes it anew") from error
    if not rounds:
        return []
    file = Path(run) / "figures" / "repair_rounds.svg"
    write_whole(file, svg(repair_rounds(rounds)))
    beside = Path(run) / "figures" / "repair_pareto.svg"
    first = rounds[0]
    goal = {"distance to the goal / before": "goal_distance"} if first.get("goal_distance") else {}
    costs = {"change of actions [m/s²]": "changed", **goal}
    points = [
        (
            f"round {row['round']}",
            {"control steps with a contact [%]": 100 * row["contact_steps"]}
            | {name: row[key] / (first[key] if key == "goal_distance" else 1) for name, key in costs.items()},
        )
        for row in rounds
    ]
    write_whole(beside, svg(pareto(points, "control steps with a contact [%]", list(costs))))
    return [
        FigureFile(
            beside, "What fewer contacts cost",
            "Every point is a round's policy in scenes that it had not learned from: contacts over the root mean "
            "square change of its executed actions in its own states, and over where it ends up.",
        ),
        FigureFile(
            file, "Repair, round by round",
            "Every round acts in scenes of its own and learns from them afterwards, so each point is of scenes that "
            f"were not learned from. On the logarithmic axis, none at all stands at {FLOOR}%.",
        )
    ]  # fmt: skip
