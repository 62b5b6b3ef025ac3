"""What a network learned, to look at: force fields, contributions along a trajectory, figures 4.4 and 5.1."""

import io
from collections.abc import Mapping
from dataclasses import replace

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm, PowerNorm
from matplotlib.figure import Figure

from envs.trajectories import AGENT, Trajectories, concatenate
from gnn.contributions import NOTHING
from gnn.force_fields import ForceField
from gnn.separation import HORIZONS, Column
from swarmnet.figures import NARROW, STYLE, WIDE, blank_figure, paths_over_paths

KINDS = {"goal": "#009E73", "obstacle": "#D55E00", "agent": "#0072B2", NOTHING: "#8a9099"}
"""Colours of edge types; grey is what is left without any edge."""
MAGNITUDE = LinearSegmentedColormap.from_list("magnitude", mpl.colormaps["YlGnBu"](np.linspace(0, 0.62, 64)))
"""Light enough for dark arrows."""
_GRID = LinearSegmentedColormap.from_list("errors", ["#9fd8b8", "#f7f3dc", "#ee9b7d"])
"""Light enough for figures on it."""
ARROWS = 13
"""Arrows in a row of a field, at most."""


def force_field_figure(fields: list[ForceField]) -> Figure:
    """A row for each field: learned on the left, the true law on the right where it is known, on the same scales.

    Colour is the magnitude [m/s^2] within the limit of acceleration; arrows point where the receiver, in the middle, is
    pushed.
    """
    beside = any(field.true is not None for field in fields)
    figure = blank_figure(NARROW if beside else 0.62 * NARROW, 0.35 + 2.6 * len(fields))
    panels = figure.subplots(len(fields), 2 if beside else 1, squeeze=False)
    for row, field in zip(panels, fields, strict=True):
        learned, true = field.executed(field.learned), None if field.true is None else field.executed(field.true)
        shown = [learned] if true is None else [learned, true]
        most = max(float(np.linalg.norm(one, axis=-1).max()) for one in shown) or 1.0
        name = f"{field.kind} → agent"
        said = "" if true is None else f"\nR² {field.r2:.3f}, error {field.relative_error:.0%}"
        _field(row[0], field, learned, most, f"{name}, learned{said}")
        for ax in row[1:]:
            ax.set_axis_off()
        if true is not None:
            row[1].set_axis_on()
            _field(row[1], field, true, most, f"{name}, true law\n", label=False)
        colours = row[0].collections[0]
        bar = figure.colorbar(colours, ax=list(row), shrink=0.85, pad=0.02, aspect=24)
        bar.set_label("magnitude [m/s²]")
        bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    return figure


def _field(
    ax: Axes, field: ForceField, force: Float[np.ndarray, "R R 2"], most: float, title: str, *, label: bool = True
) -> None:
    x, y, size = field.grid[..., 0], field.grid[..., 1], np.linalg.norm(force, axis=-1)
    # Repulsion at short range dwarfs everything else: a square root keeps both in sight.
    norm = PowerNorm(0.5, vmin=0, vmax=most)
    ax.pcolormesh(x, y, size, norm=norm, cmap=MAGNITUDE, shading="nearest", rasterized=True, gid="magnitude")
    step = -(-len(force) // ARROWS)
    every = slice(step // 2, None, step)
    pitch = float(x[0, 1] - x[0, 0]) * step
    arrow = np.where(size[..., None] > 0, force / np.maximum(size, 1e-12)[..., None], 0)
    arrow = arrow * 0.85 * pitch * np.sqrt(size / most)[..., None] ** 0.7
    ax.quiver(
        x[every, every], y[every, every], arrow[every, every, 0], arrow[every, every, 1], angles="xy",
        scale_units="xy", scale=1, pivot="mid", color="#1b1f27", width=0.006, headwidth=4, gid="arrows",
    )  # fmt: skip
    if field.over == "position":
        ax.plot(0, 0, "o", color="white", markeredgecolor="#1b1f27", markersize=6, gid="receiver")
    unit = "m" if field.over == "position" else "m/s"
    ax.set(aspect="equal", xlabel=f"relative {field.over} x [{unit}]")
    ax.set_ylabel(f"y [{unit}]" if label else "")
    ax.set_title(title, fontsize=9.5, pad=4)
    ax.locator_params(nbins=5)
    ax.grid(visible=False)


def contribution_figure(
    parts: dict[str, Float[np.ndarray, "T N 2"]], *, dt: float | int, agents: tuple[int, ...], first_row: int = 0
) -> Figure:
    """For each agent the size of every edge type's part of the predicted acceleration over time; black: of the sum."""
    figure = blank_figure(NARROW, 0.7 + 1.75 * len(agents))
    panels = figure.subplots(len(agents), 1, sharex=True, squeeze=False)[:, 0]
    total = np.sum(list(parts.values()), axis=0)
    time = dt * (first_row + np.arange(len(total)))
    for panel, agent in zip(panels, agents, strict=True):
        panel.plot(
            time, np.linalg.norm(total[:, agent], axis=-1), color="#1b1f27", linewidth=1.2, label="all", gid="all"
        )
        for kind in KINDS:
            if kind in parts:
                size = np.linalg.norm(parts[kind][:, agent], axis=-1)
                style = ":" if kind == NOTHING else "-"
                panel.plot(time, size, color=KINDS[kind], linestyle=style, label=kind, gid=kind)
        panel.set_title(f"agent {agent + 1}", loc="left", pad=3, fontsize=10)
        panel.set_ylim(bottom=0)
        panel.set_ylabel("[m/s²]")
    panels[-1].set_xlim(time[0], time[-1])
    panels[-1].set_xlabel("time [s]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=5, columnspacing=1.0, handlelength=1.4)
    return figure


def separation_figure(columns: dict[str, Column], scenes: tuple[int, ...] = (0, 1)) -> Figure:
    """Figure 5.1: a row for each scene, a column for each subset; colour: the network, dashed: the expert's same rules.

    Obstacle and goal are drawn where their edges are on. Titles give the subset, and its error at 5 and 40 steps.
    """
    solid, dashed, titles = [], [], []
    for scene in scenes:
        for name, column in columns.items():
            truth = _felt(column.truth.take([scene]), column.kinds)
            guess = column.predicted.take([scene])
            solid.append(replace(truth, position=guess.position, velocity=guess.velocity, mask=truth.mask & guess.mask))
            dashed.append(truth)
            error = dict(zip(column.error.horizons, column.error.published_mean, strict=True))
            figures = " / ".join(f"{error[h]:.2g}" for h in HORIZONS if h in error)
            titles.append(f"({name}) {' + '.join(column.kinds)}\n{figures}" if scene == scenes[0] else "")
    figure = paths_over_paths(concatenate(solid), concatenate(dashed), titles, columns=len(columns))
    figure.set_size_inches(1.35 * WIDE, figure.get_size_inches()[1] * 1.35)
    return figure


@mpl.rc_context(STYLE)
def error_grid(errors: Mapping[str, Mapping[str, float]], titles: Mapping[str, str], *, label: str) -> Figure:
    """A line for each network, a square for each column: the error, coloured on a log scale. Grey where there is none.

    Args:
      errors: network -> column -> error.
      titles: column -> what stands above it, in this order.
      label: what the numbers are, below.
    """
    values = np.array([[row.get(name, np.nan) for name in titles] for row in errors.values()], float)
    bad = ~(np.isfinite(values) & (values > 0))
    figure = blank_figure(WIDE, 1.2 + 0.3 * len(values))
    axes = figure.subplots()
    good = values[~bad] if not bad.all() else np.ones(1)
    scale = LogNorm(float(good.min()), max(float(good.max()), 1.01 * float(good.min())))
    axes.set_facecolor("#d9dce1")
    axes.pcolormesh(np.ma.masked_array(values, bad), norm=scale, cmap=_GRID, edgecolor="white", lw=1.5)
    for (line, place), value in np.ndenumerate(values):
        if not np.isnan(value):
            text = f"{value:.2g}" if value < 100 else f"{value:.0f}"
            axes.text(place + 0.5, line + 0.5, text, ha="center", va="center", fontsize=9)
    axes.set_xticks(np.arange(len(titles)) + 0.5, list(titles.values()))
    axes.set_yticks(np.arange(len(values)) + 0.5, list(errors))
    axes.invert_yaxis()
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(label)
    for text in (*axes.get_xticklabels(), *axes.get_yticklabels(), axes.xaxis.label):
        text.set_fontsize(9)
    return figure


def _felt(trajectories: Trajectories, kinds: tuple[str, ...]) -> Trajectories:
    """Nodes whose edges are off are left out of the drawing."""
    felt = np.array([name in kinds for name in ("goal", "obstacle")] + [True])[trajectories.kind]
    return replace(trajectories, mask=trajectories.mask & (felt | (trajectories.kind == AGENT))[:, None])


@mpl.rc_context(STYLE)
def png(figure: Figure, dpi: int = 160) -> bytes:
    """The figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()
