"""Figures of the thesis's chapters 3 and 4: trajectories and arrays in, matplotlib `Figure` out (`sheets.write_sheet`).

An agent has the same colour in every panel, that of the videos. Colours of a scale (horizons, neighbourhoods) are
viridis without its lightest end, in order.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR, agent_color
from swarm_mjcf.errors import SpecError
from swarmnet.sheets import STYLE, WIDTHS

_GREY, _TRUTH, _FAINT = "#4a505a", "#8a9099", "#e4e7ec"
_LETTER = 0.065
"""Width of a title's letter [in]: longer titles are broken."""
_BEYOND = 1.5
"""Predictions may widen a panel to this many times the size of the truth; what runs farther away leaves the panel."""


@dataclass(frozen=True)
class Shown:
    """One panel: a scene as it was, and as a network predicted it from its first rows alone."""

    truth: Trajectories
    """One scene."""
    predicted: Trajectories
    """The same scene; rows up to `first` are the truth's, later ones predicted."""
    title: str
    first: int = 0
    """The last row that the network was given."""
    agents: tuple[int, ...] | None = None
    """Numbers of the agents that are drawn; None: all."""

    def __post_init__(self) -> None:
        if (len(self.truth), len(self.predicted)) != (1, 1) or self.truth.mask.shape != self.predicted.mask.shape:
            raise SpecError(
                "predicted", f"{self.predicted.mask.shape} beside {self.truth.mask.shape}", "one scene, twice"
            )


@mpl.rc_context(STYLE)
def prediction_sheet(panels: Sequence[Shown], *, columns: int, note: str = "", side: Sequence[str] = ()) -> Figure:
    """Figures 3.5, 3.7, 3.8, 4.2, 4.3, 4.5: predicted movement as arrows over the truth, one scene per panel.

    An arrow ends at each predicted position and is as long as the predicted velocity carries in one step; a circle is
    where prediction starts. The truth is dashed grey, the goal a green dot, an obstacle a grey disc of its true radius.
    Axes are in metres, equal in x and y.

    Args:
      panels: line by line.
      columns: panels side by side.
      note: small print below: number of demonstrations, dt, seed.
      side: names of the lines of panels from top to bottom; none by default.

    Raises:
      SpecError: no panels, no columns, or another number of names than lines.
    """
    if not panels or columns < 1:
        raise SpecError("panels", f"{len(panels)} in {columns} columns", "at least 1 panel in at least 1 column")
    lines = math.ceil(len(panels) / columns)
    names = list(side) or [""] * lines
    if len(names) != lines:
        raise SpecError("side", names, f"{lines} names, one for each line of panels")
    width = WIDTHS["page"]
    inches = (width - 0.3) / columns - 0.25
    titles = [fill(panel.title, max(8, round((inches + 0.25) / _LETTER)), break_on_hyphens=False) for panel in panels]
    more = sum(max(title.count("\n") for title in titles[i : i + columns]) for i in range(0, len(titles), columns))
    height = lines * (inches + 0.32) + 0.3 + 0.14 * more + 0.17 * (note.count("\n") + 1 if note else 0)
    figure = _blank(width, height)
    grid = figure.subplots(lines, columns, squeeze=False)
    for number, (axes, panel) in enumerate(zip(grid.ravel(), panels, strict=False)):
        _draw(axes, panel, inches)
        axes.set_title(titles[number])
        ticks = max(2, min(5, round(inches / 0.45)))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(ticks, steps=[1, 2, 5, 10]))
        if number + columns >= len(panels):
            axes.set_xlabel("x [m]")
        if number % columns == 0:
            name = names[number // columns]
            axes.set_ylabel(f"{name}\ny [m]" if name else "y [m]")
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    _foot(figure, _entries(panels), note)
    return figure


def _draw(axes: Axes, panel: Shown, inches: float) -> None:
    truth, predicted = panel.truth, panel.predicted
    goals, obstacles, agents = (np.flatnonzero(truth.kind[0] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    chosen = range(len(agents)) if panel.agents is None else panel.agents
    small = min(1.0, inches / 1.8) ** 0.5
    crowd = min(1.0, (12 / max(len(chosen), 1)) ** 0.5) * small
    boxes: list[np.ndarray] = []
    for node in obstacles[truth.mask[0, 0, obstacles]]:
        (x, y), radius = truth.position[0, 0, node].astype(float), float(truth.radius[0, node])
        axes.add_patch(Circle((x, y), radius, facecolor=OBSTACLE_COLOR, alpha=0.6, lw=0, zorder=1, gid="obstacle"))
        boxes += [np.array([[x - radius, y - radius], [x + radius, y + radius]])]
    for node in goals[truth.mask[0, 0, goals]]:
        axes.plot(*truth.position[0, 0, node], "o", color=GOAL_COLOR, ms=5 * small, zorder=5, gid="goal")
        boxes.append(truth.position[0, :1, node])
    for number in chosen:
        node, there = agents[number], truth.mask[0, :, agents[number]]
        path = np.where(there[:, None], truth.position[0, :, node], np.nan)
        axes.plot(*path.T, color=_TRUTH, lw=0.9 * crowd, ls=(0, (3, 2)), zorder=2, gid=f"truth {number}")
        boxes.append(path[there])
    low, high = _box(boxes)
    reach = _BEYOND * max(float((high - low).max()), 1e-3) / 2
    seen = predicted.position[0][predicted.mask[0] & np.isin(np.arange(predicted.mask.shape[2]), agents[list(chosen)])]
    near = seen[np.abs(seen - (low + high) / 2).max(axis=-1) <= reach]
    low, high = _box([*boxes, near])
    middle, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1e-3)
    for number in chosen:
        _arrows(axes, predicted, int(agents[number]), panel.first, agent_color(number), 0.025 * half / inches * crowd)
        there = predicted.mask[0, panel.first, agents[number]]
        if there:
            axes.plot(
                *predicted.position[0, panel.first, agents[number]], "o", ms=3.4 * crowd, mfc="white", zorder=4,
                mec=agent_color(number), mew=0.8 * crowd, gid=f"start {number}",
            )  # fmt: skip
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")


def _arrows(
    axes: Axes, t: Trajectories, node: int, first: int, color: tuple[float, float, float], width: float
) -> None:
    """Arrows of what is predicted, `width` [m] thick: they end where the agent is, v dt long, as its step was."""
    rows = first + 1 + np.flatnonzero(t.mask[0, first + 1 :, node])
    if not len(rows):
        return
    arrows = axes.quiver(
        *t.position[0, rows, node].T, *t.velocity[0, rows, node].T, color=color, angles="xy", units="xy",
        scale_units="xy", scale=1 / t.dt, width=width, headwidth=4, headlength=4.5, headaxislength=4, minlength=0.5,
        pivot="tip", zorder=3,
    )  # fmt: skip
    arrows.set_gid(f"predicted {node}")


def _box(points: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner [m] of all points (P, 2)."""
    together = np.concatenate([np.asarray(p, float).reshape(-1, 2) for p in points] or [np.zeros((0, 2))])
    if not len(together):
        return -np.ones(2), np.ones(2)
    return together.min(axis=0), together.max(axis=0)


def _entries(panels: Sequence[Shown]) -> list[Line2D]:
    def entry(label: str, marker: str = "", **style: Any) -> Line2D:
        return Line2D([], [], label=label, marker=marker, **{"ls": "", "color": _GREY, "ms": 4, "mew": 0.8} | style)

    entries = [
        entry("prediction starts", "o", mfc="white"),
        entry("predicted", r"$\rightarrow$", ms=8, mew=0),
        entry("truth", ls=(0, (3, 2)), color=_TRUTH, lw=0.9),
    ]
    truths = [panel.truth for panel in panels]
    if any((t.mask & (t.kind == GOAL)[:, None]).any() for t in truths):
        entries.append(entry("goal", "o", color=GOAL_COLOR, ms=4.5, mew=0))
    if any((t.mask & (t.kind == OBSTACLE)[:, None]).any() for t in truths):
        entries.append(entry("obstacle", "o", color=OBSTACLE_COLOR, ms=6, alpha=0.6, mew=0))
    return entries


@mpl.rc_context(STYLE)
def error_by_size(
    errors: Mapping[int, Float[np.ndarray, "seeds sizes"]], sizes: Sequence[int], *, note: str = ""
) -> Figure:
    """Figure 3.6: error by number of demonstrations, a line per horizon, relative to the mean error at `sizes[0]`.

    Lines are means over seeds, bands go from the least to the greatest, dots are single seeds. NaN where there is none.

    Args:
      errors: horizon [steps] -> normalized error by seed and size.
      sizes: numbers of demonstrations, growing.
      note: small print below.

    Raises:
      SpecError: sizes do not grow, or an array has another number of sizes.
    """
    if list(sizes) != sorted(set(sizes)) or not sizes:
        raise SpecError("sizes", tuple(sizes), "at least one, growing")
    figure = _blank(WIDTHS["column"], 2.75)
    axes = figure.subplots()
    for (horizon, values), color in zip(sorted(errors.items()), _scale(len(errors)), strict=True):
        relative = relative_errors(values, len(sizes))
        have = np.isfinite(relative).any(axis=0)
        at, shown = np.asarray(sizes)[have], relative[:, have]
        mean, low, high = (np.asarray(f(shown, axis=0)) for f in (np.nanmean, np.nanmin, np.nanmax))
        axes.fill_between(at, low, high, color=color, alpha=0.18, lw=0, gid=f"spread {horizon}")
        label = f"{horizon} step" + ("s" if horizon > 1 else "")
        axes.plot(at, mean, color=color, lw=1.3, marker="o", ms=3, label=label, gid=f"mean {horizon}")
        if len(shown) > 1:
            single = np.broadcast_to(at, shown.shape)
            axes.plot(single.ravel(), shown.ravel(), ".", color=color, ms=2, alpha=0.6, gid=f"seeds {horizon}")
    axes.set(xscale="log", yscale="log", xlabel="demonstrations", ylabel=f"error / error with {_short(sizes[0])}")
    axes.set_xticks(list(sizes), [_short(size) for size in sizes])
    axes.xaxis.set_minor_locator(NullLocator())
    _plain_log(axes.yaxis, *axes.get_ylim())
    axes.grid(color=_FAINT, lw=0.5)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    handles, _ = axes.get_legend_handles_labels()
    _foot(figure, handles, note, columns=3)
    return figure


def relative_errors(values: Float[np.ndarray, "seeds sizes"], sizes: int) -> Float[np.ndarray, "seeds sizes"]:
    """Errors divided by the first size's mean over seeds; NaN where that size has none.

    Raises SpecError when the array has another number of sizes.
    """
    values = np.asarray(values, float)
    if values.shape[1] != sizes:
        raise SpecError("errors", values.shape, f"(seeds, {sizes})")
    first = values[:, 0][np.isfinite(values[:, 0])]
    return values / (first.mean() if len(first) else np.nan)


@mpl.rc_context(STYLE)
def norm_distributions(
    norms: Mapping[str, Mapping[str, Mapping[str, Float[np.ndarray, " n"]]]], *, note: str = ""
) -> Figure:
    """Figure 4.4: how the norms of a network's inner vectors are distributed, on a log axis of norms.

    `norms[line][part][data]`: e.g. line "before tuning", part "message", data "(3, 1)". Each curve is a histogram in
    bins of equal ratio, of unit area over log10 of the norm; the same colour is the same data. Panels of one part
    share their axis, which holds 99.8% of the values of each data.

    Raises SpecError when there is nothing to draw.
    """
    lines = list(norms)
    parts = list(dict.fromkeys(part for line in norms.values() for part in line))
    labels = list(dict.fromkeys(data for line in norms.values() for part in line.values() for data in part))
    if not labels:
        raise SpecError("norms", dict(norms), "norms of at least one part of the network on one data set")
    figure = _blank(WIDTHS["page"], 1.55 * len(lines) + 0.75)
    grid = figure.subplots(len(lines), len(parts), squeeze=False, sharex="col")
    colors = dict(zip(labels, _scale(len(labels)), strict=True))
    for column, part in enumerate(parts):
        edges = _log_bins([values for line in norms.values() for values in line.get(part, {}).values()])
        for row, line in enumerate(lines):
            axes = grid[row, column]
            for data, values in norms[line].get(part, {}).items():
                density = log_density(values, edges)
                axes.stairs(density, edges, color=colors[data], lw=1.1, gid=f"norms {data}")
                axes.stairs(density, edges, color=colors[data], alpha=0.10, fill=True, lw=0)
            axes.set(xscale="log", xlim=(edges[0], edges[-1]), yticks=[])
            axes.set_ylim(bottom=0)
            _plain_log(axes.xaxis, edges[0], edges[-1])
            axes.spines[["top", "right", "left"]].set_visible(False)
            if row == 0:
                axes.set_title(part)
            if row == len(lines) - 1:
                axes.set_xlabel("norm")
            if column == 0:
                axes.set_ylabel(line)
    handles = [Line2D([], [], color=colors[data], lw=1.5, label=data) for data in labels]
    _foot(figure, handles, note, columns=min(len(handles), 9))
    return figure


def log_density(values: Float[np.ndarray, " n"], edges: Float[np.ndarray, " bins1"]) -> Float[np.ndarray, " bins"]:
    """Share of the values in each bin divided by the bin's width in decades; values of 0 are in no bin."""
    counts, _ = np.histogram(values, edges)
    return counts / max(len(values), 1) / np.diff(np.log10(edges))


def _log_bins(samples: Sequence[np.ndarray], bins: int = 60) -> np.ndarray:
    """Edges of bins of equal ratio around 99.8% of each of the samples."""
    positive = [values[(values > 0) & np.isfinite(values)] for values in map(np.asarray, samples)]
    limits = np.array([np.quantile(values, (0.001, 0.999)) for values in positive if len(values)])
    low, high = (float(limits[:, 0].min()), float(limits[:, 1].max())) if len(limits) else (0.1, 10.0)
    low = max(low, high * 1e-5)  # a few vectors near 0 would else take the whole axis
    return np.geomspace(low / 1.05, high * 1.05, bins + 1)


def _scale(count: int) -> list[str]:
    """That many colours in order, told apart on white."""
    return [to_hex(color) for color in mpl.colormaps["viridis"](np.linspace(0.0, 0.88, count))]


def _short(size: int) -> str:
    """1000 -> 1K."""
    return f"{size / 1000:g}K" if size >= 1000 else str(size)


def _plain_log(axis: Axis, low: float, high: float) -> None:
    """Plain numbers on a log axis, at 1, 2, 5 of a decade where few decades are shown."""
    axis.set_major_locator(LogLocator())
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(LogLocator(subs=(2, 5) if high / low < 300 else ()))
    axis.set_minor_formatter(lambda value, _: f"{value:g}")


def _foot(figure: Figure, handles: Sequence[Any], note: str, columns: int | None = None) -> None:
    """Legend and small print below the panels."""
    legend = figure.legend(
        handles=list(handles), loc="outside lower center", ncols=columns or len(handles), frameon=False,
        handletextpad=0.3, columnspacing=1.1, handlelength=1.8, borderaxespad=0.2, title=note or None,
    )  # fmt: skip
    legend.get_title().set(fontsize=6, color=_GREY)


def _blank(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure
