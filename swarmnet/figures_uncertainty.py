"""Figure 3.9 and its scores: sampled futures as envelopes over what happened, and how honest they are by horizon."""

from typing import Any

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from gnn.calibration import TARGET
from gnn.scores import Scores
from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR, agent_color
from swarm_mjcf.errors import SpecError
from swarmnet.figures import BASELINES, EXPERT, MODEL, STYLE, WIDE, blank_figure

SHARES = (0.05, 0.25, 0.5)
"""An envelope's edges: at least this share of the sampled futures passes within `REACH`; darker inside."""
CELLS = 150
"""Cells along each side of the raster on which passing futures are counted."""
REACH = 0.012
"""Of a path, in sides of the window."""
BINS = 30
"""Of a histogram."""
TOP, GROUND, BELOW = 6, 5, 4


@mpl.rc_context(STYLE)
def figure_3_9(
    futures: Float[np.ndarray, "K h V 4"],
    truth: Trajectories,
    *,
    scene: int = 0,
    start: int = 0,
    step: int = 30,
    highlight: tuple[int, int] | None = None,
) -> Figure:
    """Left: where the sampled futures of all agents go, over the true paths. Middle: of two agents. Right: at `step`.

    `futures` go on from row `start` of `scene` of `truth`. `highlight`: numbers of the two agents in the middle; those
    whose futures spread most by default. Right: histograms of x and y of all agents, `step` steps ahead; dashes: truth.
    Raises SpecError for a step or an agent that is not there.
    """
    horizon, agents = futures.shape[1], np.flatnonzero(truth.kind[scene] == AGENT)
    agents = agents[truth.mask[scene, start, agents]]
    if not 1 <= step <= horizon:
        raise SpecError("step", step, f"from 1 to {horizon}, the steps that were predicted")
    if highlight is None:
        highlight = most_spread(futures[:, :, agents, :2])
    if not all(0 <= number < len(agents) for number in highlight):
        raise SpecError("highlight", highlight, f"numbers of agents from 0 to {len(agents) - 1}")
    rows = slice(start, start + horizon + 1)
    position, here = truth.position[scene, rows], truth.mask[scene, rows]
    start_row = np.broadcast_to(position[:1], (len(futures), 1, *position.shape[1:]))
    paths = np.concatenate([start_row, futures[..., :2]], axis=1)  # (K, h + 1, V, 2)

    figure = blank_figure(WIDE, 4.2)
    parts: Any = figure.subfigures(1, 3, width_ratios=(1, 1, 0.85))
    left, middle, right = parts
    middle_of, half = _window(np.concatenate([paths[:, :, agents].reshape(-1, 2), position[0]]))
    for part, numbers, title in (
        (left, range(len(agents)), "all agents"),
        (middle, highlight, f"agents {highlight[0] + 1} and {highlight[1] + 1}"),
    ):
        ax = part.subplots()
        ax.set_title(title)
        ax.set(xlim=middle_of[0] + half * np.array([-1, 1]), ylim=middle_of[1] + half * np.array([-1, 1]))
        ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
        _world(ax, truth, scene, position)
        for number in numbers:
            node = agents[number]
            _envelope(ax, paths[:, :, node], agent_color(number), middle_of, half)
            path = position[here[:, node], node]
            ax.plot(*path.T, color=EXPERT, linestyle=(0, (3, 1.5)), linewidth=1.4, zorder=GROUND, gid=f"truth {number}")
            ax.plot(*path[0], "o", color=agent_color(number), markeredgecolor="white", markersize=6, zorder=TOP)
    _histograms(right, futures[:, step - 1, agents, :2], position[step, agents], step, truth.dt)
    handles = [
        Line2D([], [], color=MODEL, linewidth=7, alpha=0.45, label="sampled futures"),
        Line2D([], [], color=EXPERT, linestyle=(0, (3, 1.5)), linewidth=1.4, label="what happened"),
        Line2D([], [], color=GOAL_COLOR, marker="o", linestyle="", markersize=8, label="goal"),
        Line2D([], [], color=OBSTACLE_COLOR, marker="o", linestyle="", markersize=11, alpha=0.55, label="obstacle"),
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=4, columnspacing=1.4)
    return figure


def most_spread(paths: Float[np.ndarray, "K h N 2"]) -> tuple[int, int]:
    """The two agents with the largest mean variance of position, by number; both the same where there is one."""
    order = np.argsort(-paths.var(axis=0).mean(axis=(0, 2)))
    return int(order[0]), int(order[min(1, len(order) - 1)])


def passing_share(
    paths: Float[np.ndarray, "K T 2"], centre: Float[np.ndarray, "2"], half: float, reach: float = REACH
) -> Float[np.ndarray, "C C"]:
    """Share of K paths that pass within `reach` sides of each cell (y, x) of a square window of `2 half` metres."""
    between = np.linspace(0, 1, 12, endpoint=False)[:, None, None, None]
    dense = (paths[None, :, :-1] * (1 - between) + paths[None, :, 1:] * between).swapaxes(0, 1)  # (K, 12, T - 1, 2)
    cell = np.floor((dense - (centre - half)) / (2 * half) * CELLS).astype(int).reshape(len(paths), -1, 2)
    share, radius = np.zeros((CELLS, CELLS)), max(1, round(reach * CELLS))
    span = np.arange(-radius, radius + 1)
    disc = np.argwhere(span[:, None] ** 2 + span**2 <= radius**2 + 0.5) - radius
    for one in cell:
        near = (one[:, None] + disc).reshape(-1, 2)
        near = near[((near >= 0) & (near < CELLS)).all(axis=1)]
        passed = np.zeros((CELLS, CELLS), bool)
        passed[near[:, 1], near[:, 0]] = True
        share += passed
    return share / len(paths)


def _envelope(
    ax: Axes, paths: Float[np.ndarray, "K T 2"], color: tuple, centre: Float[np.ndarray, "2"], half: float
) -> None:
    share = passing_share(paths, centre, half)
    at = (np.arange(CELLS) + 0.5) / CELLS * 2 * half - half
    for low in SHARES:
        if (share >= low).any():
            ax.contourf(
                at + centre[0], at + centre[1], share, levels=[low, 2], colors=[color], alpha=0.25, zorder=BELOW
            )
    for path in paths[:12]:
        ax.plot(*path.T, color=color, linewidth=0.5, alpha=0.5, zorder=BELOW)


def _window(points: Float[np.ndarray, "P 2"]) -> tuple[Float[np.ndarray, "2"], float]:
    """Centre and half a side [m] of a square that holds nearly all points."""
    low, high = np.quantile(points, 0.002, axis=0), np.quantile(points, 0.998, axis=0)
    return (low + high) / 2, 0.56 * max(float((high - low).max()), 1.0)


def _world(ax: Axes, truth: Trajectories, scene: int, position: Float[np.ndarray, "T V 2"]) -> None:
    kind, there = truth.kind[scene], truth.mask[scene, 0]
    for k in np.flatnonzero((kind == OBSTACLE) & there):
        x, y = map(float, position[0, k])
        ax.add_patch(Circle((x, y), float(truth.radius[scene, k]), facecolor=OBSTACLE_COLOR, alpha=0.55, zorder=2))
    for g in np.flatnonzero((kind == GOAL) & there):
        ax.plot(*position[0, g], "o", color=GOAL_COLOR, markeredgecolor="white", markersize=10, zorder=TOP, gid="goal")


def _histograms(
    part, places: Float[np.ndarray, "K N 2"], truth: Float[np.ndarray, "N 2"], step: int, dt: float
) -> None:
    axes = part.subplots(2, 1)
    for dimension, (ax, name) in enumerate(zip(axes, "xy", strict=True)):
        low, high = (float(f(places[..., dimension])) for f in (np.min, np.max))
        bins = np.linspace(low, max(high, low + 1e-3), BINS + 1)
        for number in range(places.shape[1]):
            style = {"bins": bins, "color": agent_color(number), "weights": np.full(len(places), 1 / len(places))}
            ax.hist(places[:, number, dimension], histtype="stepfilled", alpha=0.35, linewidth=0, **style)
            ax.hist(places[:, number, dimension], histtype="step", linewidth=1.3, **style)
            ax.axvline(truth[number, dimension], color=agent_color(number), linestyle=(0, (3, 1.5)), linewidth=1.2)
        ax.set(xlabel=f"{name} [m]", ylabel="share")
        ax.locator_params(axis="x", nbins=6)
        ax.grid(axis="x", visible=False)
    axes[0].set_title(f"{step} steps ahead ({step * dt:g} s)")


@mpl.rc_context(STYLE)
def scores_by_horizon(scores: dict[str, Scores], *, dt: float) -> Figure:
    """Coverage (goal shaded), energy score, NLL and width of the 90% band over predicted steps, a colour per method."""
    figure = blank_figure(WIDE, 6.6)
    coverage, energy, nll, width = figure.subplots(2, 2).ravel()
    coverage.axhspan(*TARGET, color="#cfe8d5", zorder=0, linewidth=0)
    for level in (0.5, 0.9):
        coverage.axhline(level, color="#8a9099", linewidth=1)
    styles = ((MODEL, "-"), *BASELINES, (EXPERT, (0, (1, 1))))
    for (name, one), (color, line) in zip(scores.items(), styles, strict=False):
        steps = np.arange(1, len(one.energy) + 1)
        coverage.plot(steps, one.coverage_90, color=color, linestyle=line, gid=f"90 {name}", label=name)
        coverage.plot(steps, one.coverage_50, color=color, linestyle=line, linewidth=1.2, gid=f"50 {name}")
        for ax, values in ((energy, one.energy), (nll, one.nll), (width, one.width_90)):
            ax.plot(steps, values, color=color, linestyle=line, gid=name)
    coverage.set(ylim=(0, 1), ylabel="coverage of the 50% and 90% bands", yticks=(0, 0.25, 0.5, 0.75, 0.9, 1))
    energy.set(ylabel="energy score [m]", ylim=(0, None))
    # A band that is far too narrow has an NLL without bound: it leaves the panel.
    finest = [float(np.nanmin(one.nll)) for one in scores.values()]
    widest = min(float(np.nanmax(one.nll)) for one in scores.values())
    nll.set(ylabel="NLL of a position [nats]", ylim=(min(finest) - 1, max(widest, min(finest) + 1) + 4))
    width.set(ylabel="width of the 90% band [m]", ylim=(0, None))
    for ax in (nll, width):
        ax.set_xlabel(f"predicted steps of {dt:g} s")
    figure.legend(loc="outside upper left", ncols=4, columnspacing=1.2)
    return figure
