"""Still sheets of trajectories for papers: axes in metres, bodies at their true size, text that stays text in a PDF."""

import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR, agent_color
from swarm_mjcf.errors import SpecError
from swarm_mjcf.video import Unfinished, refused
from swarmnet.film import Panel

WIDTHS = {"column": 3.4, "page": 7.0}
"""Widths of a sheet [inches]: one column, or both, of a usual paper."""
COLORS = ("agent", "time")
DPI = 300
"""Of a sheet written as PNG."""
STYLE: Any = {
    "font.size": 7, "axes.titlesize": 7, "axes.labelsize": 7, "xtick.labelsize": 6, "ytick.labelsize": 6,
    "legend.fontsize": 6.5, "axes.linewidth": 0.5, "xtick.major.width": 0.5, "ytick.major.width": 0.5,
    "xtick.major.size": 2, "ytick.major.size": 2, "axes.edgecolor": "#4a505a", "pdf.fonttype": 42, "ps.fonttype": 42,
    "svg.fonttype": "none", "svg.hashsalt": "swarmnet", "axes.titlepad": 3, "axes.labelpad": 1.5,
}  # fmt: skip
"""Fonts go into a PDF as TrueType (type 42), which journals ask for."""
_CONTACT, _DASHED, _MAP = "#D0121E", "#6b717b", "viridis"
_VECTORS = 40_000
"""More line segments than this in a panel become an image within the PDF; the axes stay vectors."""


@mpl.rc_context(STYLE)
def sheet(
    panels: Sequence[Panel], *, columns: int, width: str = "column", color: str = "agent", contacts: bool = True
) -> Figure:
    """Trajectories of one scene per panel, all panels at one scale.

    Agents start at open circles and end at dots; a red cross marks the state at the end of a control step in which a
    contact began; obstacles are discs of their true radius, moving ones where they end, with a dotted path from an
    outline where they start; the goal is green; another recording of the same scene is dashed grey.

    Args:
      panels: recordings of one scene each.
      columns: panels side by side.
      width: one of `WIDTHS`.
      color: "agent" has the videos' colour for each agent, "time" a scale from start to end.
      contacts: whether contacts are marked.

    Raises:
      SpecError: a value is out of range.
    """
    for field, given, allowed in (("width", width, tuple(WIDTHS)), ("color", color, COLORS)):
        if given not in allowed:
            raise SpecError(field, given, f"one of {', '.join(allowed)}")
    if not panels or columns < 1:
        raise SpecError("panels", f"{len(panels)} in {columns} columns", "at least 1 panel in at least 1 column")
    lines, inches = -(-len(panels) // columns), WIDTHS[width]
    # What remains beside labels and ticks; the layout is exact, this only leaves no empty bands around it.
    side = (inches - 0.2 - (0.45 if color == "time" else 0)) / columns - 0.27
    figure = Figure(figsize=(inches, lines * (side + 0.33) + 0.42), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.subplots(lines, columns, squeeze=False)
    middles, half = _windows([_points(panel) for panel in panels])
    longest = max(panel.recording.dt * (panel.recording.position.shape[1] - 1) for panel in panels)
    scale = Normalize(0, longest)
    for number, (axes, panel) in enumerate(zip(grid.ravel(), panels, strict=False)):
        _draw(axes, panel, scale if color == "time" else None, contacts=contacts, inches=side)
        axes.set_title(panel.title)
        (x, y) = middles[number]
        axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
        ticks = max(2, min(5, round(side / 0.45)))
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(ticks, steps=[1, 2, 5, 10]))
        if number + columns >= len(panels):
            axes.set_xlabel("x [m]")
        if number % columns == 0:
            axes.set_ylabel("y [m]")
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    if color == "time":
        colors = ScalarMappable(scale, _MAP)
        bar = figure.colorbar(
            colors,
            ax=grid.ravel().tolist(),
            label="time [s]",
            fraction=0.04,
            pad=0.015,
            aspect=figure.get_figheight() / 0.08,
        )
        bar.outline.set_linewidth(0.5)
    entries = _legend(panels, contacts=contacts)
    lines = math.ceil(len(entries) / max(2, int(inches / 0.62)))
    figure.legend(
        handles=entries, loc="outside lower center", ncols=math.ceil(len(entries) / lines), frameon=False,
        handletextpad=0.2, columnspacing=0.9, handlelength=1.6, borderaxespad=0.2,
    )  # fmt: skip
    return figure


@mpl.rc_context(STYLE)
def write_sheet(path: str | Path, figure: Figure) -> Path:
    """Writes a sheet as PDF, PNG (300 dpi) or SVG, whole or not at all; the same data give the same file.

    Raises:
      SpecError: the name ends otherwise.
      VideoError: the folder or disk refuses.
    """
    target = Path(path)
    kind = target.suffix.lower().lstrip(".")
    nameless: dict[str, dict] = {
        "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
        "png": {"Software": None},
        "svg": {"Date": None},
    }
    if kind not in nameless:
        raise SpecError("path", str(path), "a name that ends in .pdf, .png or .svg")
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=DPI, metadata=nameless[kind])
    with Unfinished(target) as part, refused(target):
        part.write_bytes(buffer.getvalue())
    return target


def _draw(axes: Axes, panel: Panel, scale: Normalize | None, *, contacts: bool, inches: float) -> None:
    t = panel.recording
    rows, agents = t.position.shape[1], _nodes(t, AGENT)
    small = min(1.0, inches / 1.8) ** 0.5
    crowd = min(1.0, (12 / max(len(agents), 1)) ** 0.5) * small
    _obstacles(axes, t)
    for node in _nodes(t, GOAL)[t.mask[0, 0, _nodes(t, GOAL)]]:
        axes.plot(
            *t.position[0, 0, node], "P", color=GOAL_COLOR, ms=6 * small, mec="#1b7a38", mew=0.6, zorder=6, gid="goal"
        )
    if panel.reference is not None:
        for node in _nodes(panel.reference, AGENT):
            axes.plot(
                *_gaps(panel.reference, int(node)), color=_DASHED, lw=0.9 * crowd, ls=(0, (3, 2)), zorder=2,
                gid=f"dashed {node}",
            )  # fmt: skip
    segments, shade = _segments(t, agents)
    style = {"lw": 1.3 * crowd, "zorder": 3, "capstyle": "round", "rasterized": len(segments) > _VECTORS}
    if scale is None:
        color = np.array([agent_color(i) for i in range(len(agents))]).reshape(-1, 3)[shade[:, 1]]
        lines = LineCollection(list(segments), colors=color, **style)
    else:
        lines = LineCollection(list(segments), array=t.dt * (shade[:, 0] + 0.5), cmap=_MAP, norm=scale, **style)
    lines.set_gid("paths")
    axes.add_collection(lines, autolim=False)
    for number, node in enumerate(agents):
        there = np.flatnonzero(t.mask[0, :, node])
        if not len(there):
            continue
        first, last = there[0], there[-1]
        hue = {
            row: agent_color(number) if scale is None else mpl.colormaps[_MAP](scale(t.dt * row))
            for row in (first, last)
        }
        for row, face, name in ((first, "white", "start"), (last, hue[last], "end")):
            axes.plot(
                *t.position[0, row, node], "o", ms=3.6 * crowd, mec=hue[row], mew=0.8 * crowd, mfc=face, zorder=4,
                gid=f"{name} {number}",
            )  # fmt: skip
    if contacts:
        hit = ((t.agent_events[0] > 0) | (t.solid_events[0] > 0))[:, agents] & t.mask[0][:, agents]
        row, agent = np.nonzero(hit[:rows])
        axes.plot(
            *t.position[0, row, agents[agent]].T, "x", color=_CONTACT, ms=4.0 * max(crowd, 0.5),
            mew=0.9 * max(crowd, 0.6), ls="", zorder=5, gid="contacts",
        )  # fmt: skip


def _obstacles(axes: Axes, t: Trajectories) -> None:
    for node in _nodes(t, OBSTACLE):
        there = np.flatnonzero(t.mask[0, :, node])
        if not len(there):
            continue
        path, radius = t.position[0, there, node].astype(float), float(t.radius[0, node])
        end = PatchCollection(
            [Circle((path[-1, 0], path[-1, 1]), radius)], facecolor=OBSTACLE_COLOR, alpha=0.6, zorder=1
        )
        end.set_gid(f"obstacle {node}")
        axes.add_collection(end, autolim=False)
        if np.ptp(path, axis=0).max() > 1e-6:
            start = Circle((path[0, 0], path[0, 1]), radius, fill=False, ec=OBSTACLE_COLOR, lw=0.7, ls=":", zorder=1)
            axes.add_patch(start)
            axes.plot(*path.T, color=OBSTACLE_COLOR, lw=0.8, ls=":", zorder=1, gid=f"obstacle path {node}")


def _segments(t: Trajectories, agents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of present agents, (P, 2, 2) [m] from and to, and the row and agent of each, (P, 2)."""
    place, there = t.position[0][:, agents], t.mask[0][:, agents]
    row, agent = np.nonzero(there[1:] & there[:-1])
    return np.stack([place[row, agent], place[row + 1, agent]], axis=1), np.stack([row, agent], axis=1)


def _nodes(t: Trajectories, kind: int) -> np.ndarray:
    return np.flatnonzero(t.kind[0] == kind)


def _gaps(t: Trajectories, node: int) -> np.ndarray:
    """x and y (2, T) of a node, NaN where it is absent."""
    return np.where(t.mask[0, :, node, None], t.position[0, :, node], np.nan).T


def _points(panel: Panel) -> np.ndarray:
    """Corners [m], (P, 2), of boxes around all that is to be seen in a panel."""
    boxes = [np.zeros((0, 2))]
    for t in filter(None, (panel.recording, panel.reference)):
        place, radius = t.position[0][t.mask[0]], np.broadcast_to(t.radius[0], t.mask[0].shape)[t.mask[0]]
        boxes += [place - radius[:, None], place + radius[:, None]]
    return np.concatenate(boxes)


def _windows(points: Sequence[np.ndarray]) -> tuple[list[tuple[float, float]], float]:
    """The middle of each panel's window [m] and half the width that serves all."""
    boxes = [(p.min(axis=0), p.max(axis=0)) if len(p) else (-np.ones(2), np.ones(2)) for p in points]
    half = 0.54 * max(float((high - low).max()) for low, high in boxes)
    return [tuple(((low + high) / 2).tolist()) for low, high in boxes], max(half, 1e-3)


def _legend(panels: Sequence[Panel], *, contacts: bool) -> list[Line2D]:
    """Entries for what the sheet has."""
    recordings = [panel.recording for panel in panels]
    grey = "#4a505a"

    def entry(label: str, marker: str = "", **style: Any) -> Line2D:
        return Line2D([], [], label=label, marker=marker, **{"ls": "", "color": grey, "ms": 4, "mew": 0.8} | style)

    entries = [entry("start", "o", mfc="white"), entry("end", "o")]
    if any((t.mask & (t.kind == GOAL)[:, None]).any() for t in recordings):
        entries.append(entry("goal", "P", color=GOAL_COLOR, ms=5.5, mec="#1b7a38", mew=0.6))
    if any((t.mask & (t.kind == OBSTACLE)[:, None]).any() for t in recordings):
        entries.append(entry("obstacle", "o", color=OBSTACLE_COLOR, ms=6, alpha=0.6, mew=0))
    if contacts and any((t.agent_events > 0).any() or (t.solid_events > 0).any() for t in recordings):
        entries.append(entry("contact", "x", color=_CONTACT))
    for name in sorted({panel.reference_title for panel in panels if panel.reference is not None}):
        entries.append(entry(name or "reference", ls=(0, (3, 2)), color=_DASHED, lw=0.9))
    return entries
