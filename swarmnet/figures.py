"""Figures of a run, for a page or a paper: data in, matplotlib `Figure` out; `make_figures` writes what a run allows.

Agents have the colours of the videos; everything else is told apart by line style and by colours that the colour-blind
can tell apart (Okabe and Ito's). Sizes are for a phone: a figure is `NARROW` inches wide with text to match; the ones
with four scenes also exist in one row, for wide screens.
"""

import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.markers import MarkerStyle
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator
from matplotlib.transforms import Affine2D

from envs.collisions import worst_scenes
from envs.storage import load
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from gnn.metrics import read_metrics
from swarm_mjcf.build import GOAL_COLOR, OBSTACLE_COLOR, agent_color
from swarm_mjcf.errors import SwarmError
from swarmnet.results import write_whole

NARROW, WIDE = 5.2, 10.8
"""Widths [inches] on a phone and on a wide screen."""
MODEL, EXPERT, CONTACT = "#0072B2", "#3f444d", "#D0121E"
BASELINES = (("#D55E00", "--"), ("#009E73", ":"), ("#CC79A7", "-."))
"""Colours and line styles of rows other than the model."""
STYLE: Any = {
    "font.size": 11, "axes.titlesize": 11, "axes.labelsize": 11, "legend.fontsize": 10, "axes.spines.top": False,
    "axes.spines.right": False, "axes.edgecolor": "#8a9099", "axes.grid": True, "grid.color": "#e4e7ec",
    "axes.axisbelow": True, "legend.frameon": False, "lines.linewidth": 2.0, "xtick.color": "#3b4048",
    "ytick.color": "#3b4048", "text.color": "#22262e", "axes.labelcolor": "#22262e",
    "svg.hashsalt": "swarmnet", "svg.fonttype": "path",
}  # fmt: skip
"""Fixed salt and no date: the same data give the same file."""


@dataclass(frozen=True)
class FigureFile:
    """A figure on disk with the words that belong to it."""

    path: Path
    title: str
    caption: str
    narrow: Path | None = None
    """The same in a shape for a phone, where `path` is too wide for one."""


def learning_curves(rows: list[dict]) -> Figure:
    """Loss and validation error over gradient steps, log scale; bands are the stages of the curriculum."""
    figure = blank_figure(NARROW, 4.6)
    axes = figure.subplots(2, 1, sharex=True)
    step = [row["step"] for row in rows]
    for ax, key, label in ((axes[0], "loss", "training loss"), (axes[1], "validation_error", "validation error")):
        ax.plot(step, [row[key] for row in rows], color=MODEL, gid=key)
        _log(ax)
        ax.set_ylabel(label)
        ax.grid(axis="x", visible=False)
        for number, (first, last, _) in enumerate(stages(rows)):
            if number % 2:
                ax.axvspan(first, last, color="#eef1f5", zorder=0, linewidth=0)
    for first, last, horizon in stages(rows):
        words = f"{horizon} step" + ("s" if horizon > 1 else "")
        axes[0].annotate(
            words, ((first + last) / 2, 1), xycoords=("data", "axes fraction"), xytext=(0, 4), fontsize=10,
            textcoords="offset points", ha="center",
        )  # fmt: skip
    axes[1].set_xlim(0, max(step))
    axes[1].set_xlabel("gradient steps")
    return figure


def stages(rows: list[dict]) -> list[tuple[int, int, int]]:
    """(first step, last step, predicted steps) of each stage of the curriculum in training metrics."""
    found: list[tuple[int, int, int]] = []
    for before, row in zip([None, *rows[:-1]], rows, strict=True):
        start = before["step"] if before else 0
        if before and before["stage"] == row["stage"]:
            start = found.pop()[0]
        found.append((start, row["step"], row["horizon"]))
    return found


def error_by_horizon(prediction: dict[str, dict], *, dt: float | int) -> Figure:
    """Normalized error (`agents`) of each predicted step, log scale. `prediction`: as in evaluation.json."""
    figure = blank_figure(NARROW, 3.7)
    ax = figure.subplots()
    styles = ((MODEL, "-"), *BASELINES)
    for number, (name, error) in enumerate(prediction.items()):
        color, line = styles[number % len(styles)]
        steps = np.arange(1, len(error["by_step"]) + 1)
        marker = "o" if len(steps) == 1 else ""
        ax.plot(steps, error["by_step"], color=color, linestyle=line, label=name, gid=name, marker=marker)
    _log(ax)
    ax.set(xlabel=f"predicted steps of {dt:g} s", ylabel="normalized error")
    figure.legend(loc="outside upper left", ncols=3, columnspacing=1.2, handlelength=1.6)
    return figure


def paths_over_paths(
    solid: Trajectories, dashed: Trajectories, titles: list[str], *, columns: int, contacts: bool = False
) -> Figure:
    """Scenes side by side: `solid` in the agents' colours with arrowheads in the direction of time, `dashed` in grey.

    The goal is a green dot, obstacles are discs of their true radius, starts are open circles. With `contacts`, a red
    cross marks where a control step of `solid` ended in which that agent touched something.
    """
    lines, width = math.ceil(len(titles) / columns), NARROW if columns <= 2 else WIDE
    figure = blank_figure(width, lines * (width / columns + 0.36))
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for scene, title in enumerate(titles):
        _panel(panels[scene], solid, dashed, scene, contacts=contacts)
        panels[scene].set_title(title, pad=4)
    for panel in panels[len(titles) :]:
        panel.set_axis_off()
    return figure


def _panel(ax: Axes, solid: Trajectories, dashed: Trajectories, scene: int, *, contacts: bool) -> None:
    goals, obstacles, agents = (np.flatnonzero(solid.kind[scene] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    points = [np.zeros((0, 2))]
    for k in obstacles[solid.mask[scene, 0, obstacles]]:
        centre, radius = solid.position[scene, 0, k], float(solid.radius[scene, k])
        ax.add_patch(Circle((float(centre[0]), float(centre[1])), radius, facecolor=OBSTACLE_COLOR, alpha=0.55))
        points += [centre[None] - radius, centre[None] + radius]
    for g in goals[solid.mask[scene, 0, goals]]:
        ax.plot(*solid.position[scene, 0, g], "o", color=GOAL_COLOR, markersize=9, zorder=5, gid="goal")
        points.append(solid.position[scene, :1, g])
    for number, node in enumerate(agents):
        color = agent_color(number)
        true, there = dashed.position[scene, :, node], dashed.mask[scene, :, node]
        ax.plot(*_shown(true, there), color="#6b717b", linestyle=(0, (3, 2)), linewidth=1.6, gid=f"dashed {number}")
        points.append(true[there])
        path, there = solid.position[scene, :, node], solid.mask[scene, :, node]
        ax.plot(*_shown(path, there), color=color, linewidth=1.5, gid=f"solid {number}")
        points.append(path[there])
        if there.any():
            ax.plot(*path[there][0], "o", color=color, markerfacecolor="white", markersize=5, gid=f"start {number}")
        _arrowheads(ax, path[there], color)
        if contacts:
            hit = there & ((solid.agent_contact[scene, :, node] > 0) | (solid.solid_contact[scene, :, node] > 0))
            ax.plot(*path[hit].T, "x", color=CONTACT, markersize=9, markeredgewidth=2.4, zorder=6, gid=f"hit {number}")
    _square(ax, np.concatenate(points))


def _shown(path: np.ndarray, there: np.ndarray) -> np.ndarray:
    """x and y (2, T) with gaps where the node is absent."""
    return np.where(there[:, None], path, np.nan).T


def _arrowheads(ax: Axes, path: np.ndarray, color: tuple[float, float, float]) -> None:
    """Three triangles at equal lengths along a path (T, 2), pointing forward in time."""
    along = (
        np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]) if len(path) else np.zeros(1)
    )
    if along[-1] < 1e-6:
        return
    for share in (0.25, 0.55, 0.85):
        t = int(np.clip(np.searchsorted(along, share * along[-1]), 1, len(path) - 1))
        forward = path[t] - path[t - 1]
        turn = Affine2D().rotate(math.atan2(forward[1], forward[0]) - math.pi / 2)
        ax.plot(*path[t], marker=MarkerStyle("^", transform=turn), color=color, markersize=6, gid="arrowhead")


def _square(ax: Axes, points: np.ndarray) -> None:
    """A square window around points (P, 2) [m] without ticks, with a bar for scale in place of them."""
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(2), np.ones(2))
    middle, half = (low + high) / 2, 0.54 * max(float((high - low).max()), 1.0)
    ax.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal")
    ax.set(xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_visible(True)
        spine.set_color("#c9ced6")
    power = 10 ** math.floor(math.log10(half))
    length = max(step * power for step in (1, 2, 5) if step * power <= 0.8 * half or step == 1)
    # Below the window, where no path can cross it.
    x, y = middle[0] - half, middle[1] - 1.05 * half
    ax.plot([x, x + length], [y, y], color="#3b4048", linewidth=2.5, solid_capstyle="butt", clip_on=False, gid="scale")
    ax.annotate(
        f"{length:g} m", (x + length, y), xytext=(4, -3), textcoords="offset points", fontsize=9, annotation_clip=False
    )


def goal_distance(trajectories: Trajectories) -> np.ndarray | None:
    """Mean distance of the present agents to the goal [m], (S', T), over scenes with agents; None without a goal."""
    t = trajectories
    if not (t.kind == GOAL).any():
        return None
    goal = t.position[np.arange(len(t)), :, np.argmax(t.kind == GOAL, axis=1)]
    present = t.mask & (t.kind == AGENT)[:, None]
    distance = np.where(present, np.linalg.norm(t.position - goal[:, :, None], axis=-1), 0)
    peopled = present.any(axis=2).all(axis=1)
    return distance[peopled].sum(axis=2) / present[peopled].sum(axis=2)


def goal_over_time(runs: dict[str, Trajectories]) -> Figure:
    """Distance to the goal over time, reference first: mean over scenes, and the band that holds 80% of them."""
    figure = blank_figure(NARROW, 3.5)
    ax = figure.subplots()
    for over, (name, run), (color, line) in zip((3, 2), runs.items(), ((EXPERT, "--"), (MODEL, "-")), strict=False):
        distance = goal_distance(run)
        if distance is None or not len(distance):
            continue
        time = run.dt * np.arange(distance.shape[1])
        low, high = np.quantile(distance, [0.1, 0.9], axis=0)
        ax.fill_between(time, low, high, color=color, alpha=0.16, linewidth=0)
        # Where both agree, the dashes stay visible.
        ax.plot(time, distance.mean(axis=0), color=color, linestyle=line, label=name, gid=name, zorder=over)
    ax.set(xlabel="time [s]", ylabel="distance to the goal [m]")
    ax.set_ylim(bottom=0)
    figure.legend(loc="outside upper left", ncols=2)
    return figure


_RATES = (
    ("share of control steps with a contact", (("contact_steps_any", "any"), ("contact_steps_agent", "agent"),
                                               ("contact_steps_obstacle", "obstacle"))),
    ("share of scenes with a contact", (("ever_touching_trajectories_any", "any"),
                                        ("ever_touching_trajectories_agent", "agent"),
                                        ("ever_touching_trajectories_obstacle", "obstacle"))),
)  # fmt: skip


def contact_rates(collisions: dict[str, dict]) -> Figure:
    """Contact rates [%] with 95% intervals, expert above model. `collisions` as in evaluation.json, expert first."""
    figure = blank_figure(NARROW, 4.4)
    panels = figure.subplots(len(_RATES), 1)
    for ax, (title, rates) in zip(panels, _RATES, strict=True):
        for number, (name, report) in enumerate(collisions.items()):
            color, marker = ((EXPERT, "s"), (MODEL, "o"))[min(number, 1)]
            at = np.arange(len(rates)) + 0.17 * (2 * number - 1)
            value, low, high = (
                np.array([100 * (report[key][part] if report[key][part] is not None else np.nan) for key, _ in rates])
                for part in ("value", "low", "high")
            )
            ax.hlines(at, low, high, color=color, linewidth=2.2, gid=f"interval {name}")
            label = name if ax is panels[0] else f"_{name}"
            ax.plot(value, at, marker, color=color, markersize=7, label=label, gid=name, clip_on=False)
        ax.set_yticks(np.arange(len(rates)), [label for _, label in rates])
        ax.set_ylim(len(rates) - 0.4, -0.6)
        ax.set_xlim(left=0)
        ax.grid(axis="y", visible=False)
        ax.set_xlabel(f"{title} [%]")
    figure.legend(loc="outside upper left", ncols=2)
    return figure


def telling_scenes(trajectories: Trajectories, count: int) -> list[int]:
    """Scenes worth a look: the worst ones first (`envs.collisions.worst_scenes`)."""
    return [worst.scene for worst in worst_scenes(trajectories, count)]


def read_evaluation(run: Path) -> dict | None:
    """What `swarmnet evaluate` measured, or None. Raises SwarmError when the file cannot be read."""
    path = run / "evaluation.json"
    if not path.exists():
        return None
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SwarmError(f"{path}: cannot be read ({error}); `swarmnet evaluate {run}` writes it anew") from error
    if not isinstance(found, dict) or not isinstance(found.get("prediction"), dict):
        raise SwarmError(f"{path}: holds no evaluation; `swarmnet evaluate {run}` writes it anew")
    return found


def load_pair(run: Path, one: str, other: str) -> tuple[Trajectories, Trajectories] | None:
    """Two recordings of the same scenes from RUN/rollouts, or None when one is missing or they do not match."""
    paths = [run / "rollouts" / f"{name}.h5" for name in (one, other)]
    if not all(path.exists() for path in paths):
        return None
    first, second = load(paths[0]), load(paths[1])
    return (first, second) if first.position.shape == second.position.shape else None


@mpl.rc_context(STYLE)
def make_figures(run: str | Path) -> list[FigureFile]:
    """Writes RUN/figures/*.svg, whichever can be made from what is there; the order is that of a report."""
    run = Path(run)
    if not run.is_dir():
        raise SwarmError(f"{run}: no such run folder; `swarmnet demo` makes one")
    made: list[FigureFile] = []

    def add(name: str, title: str, caption: str, draw: Callable[[], Figure], narrow: Callable | None = None) -> None:
        paths = []
        for suffix, function in (("", draw), ("-narrow", narrow)):
            if function is not None:
                paths.append(run / "figures" / f"{name}{suffix}.svg")
                write_whole(paths[-1], svg(function()))
        made.append(FigureFile(paths[0], title, caption, paths[1] if narrow else None))

    _prediction_figures(run, add)
    _learning_figure(run, add)
    _closed_loop_figures(run, add)
    return made


def _learning_figure(run: Path, add: Callable) -> None:
    rows = read_metrics(run / "metrics.jsonl")
    if rows and "horizon" in rows[0]:  # PPO has curves of its own
        longest = max(row["horizon"] for row in rows)
        add(
            "learning", "Learning",
            "Top: training loss; it rises where the curriculum moves on to longer predictions (predicted steps above "
            f"each band). Bottom: normalized error over {longest} predicted steps on scenes kept out of training.",
            lambda: learning_curves(rows),
        )  # fmt: skip


def _prediction_figures(run: Path, add: Callable) -> None:
    sweep = load_pair(run, "sweep_truth", "sweep_predicted")
    if sweep is not None:
        truth, predicted = sweep
        titles = [f"obstacle place {number}" for number in range(1, len(truth) + 1)]
        seconds = truth.dt * (truth.position.shape[1] - 1)
        add(
            "sweep", "Predicted over true, four places of the obstacle (figure 3.5)",
            "Colour: what the network predicts from the first state alone (open loop, never corrected), arrowheads in "
            "the direction of time. Grey, dashed: the expert in physics. The same start in all, "
            f"{seconds:g} s in steps of dt = {truth.dt:g} s; green dot: goal; disc: the obstacle at its true radius.",
            lambda: paths_over_paths(predicted, truth, titles, columns=4),
            lambda: paths_over_paths(predicted, truth, titles, columns=2),
        )  # fmt: skip
    evaluation = read_evaluation(run)
    if evaluation is not None and evaluation["prediction"]:
        dt = evaluation["dt"]
        add(
            "horizon", "Prediction error by horizon",
            f"Error of each single predicted step of dt = {dt:g} s, mean over all windows of {evaluation['scenes']} "
            "unseen scenes, log scale. Normalisation `agents`: squared error over agents and all 4 dimensions, "
            "divided by the mean squared change in one step; 1 is what predicting no change costs at the first step.",
            lambda: error_by_horizon(evaluation["prediction"], dt=dt),
        )  # fmt: skip


def _closed_loop_figures(run: Path, add: Callable) -> None:
    evaluation = read_evaluation(run)
    pair = load_pair(run, "expert", "learned")
    names = [(evaluation or {}).get(key, word) for key, word in (("reference", "expert"), ("policy", "model"))]
    if pair is not None:
        expert, learned = pair
        shown = telling_scenes(learned, 4)
        one, other = learned.take(shown), expert.take(shown)
        titles = [f"scene {scene}" for scene in shown]
        add(
            "scenes", "The policy steers, in physics",
            f"Colour: agents of `{names[1]}` in MuJoCo. Grey, dashed: `{names[0]}` from the same start. Red cross: the "
            "end of a control step in which that agent touched something. Scenes with most contacts come first.",
            lambda: paths_over_paths(one, other, titles, columns=4, contacts=True),
            lambda: paths_over_paths(one, other, titles, columns=2, contacts=True),
        )  # fmt: skip
        if goal_distance(expert) is not None:
            add(
                "goal", "Distance to the goal",
                f"Mean over {len(expert)} unseen scenes of the agents' mean distance to the goal; the bands hold 80% "
                "of the scenes.",
                lambda: goal_over_time({names[0]: expert, names[1]: learned}),
            )  # fmt: skip
    if evaluation is not None and evaluation.get("collisions") and evaluation.get("contacts"):
        add(
            "contacts", "Contacts",
            f"Contacts in {evaluation['scenes']} unseen scenes, with 95% bootstrap intervals over "
            "scenes; `agent`: with another agent, `obstacle`: with an obstacle or wall.",
            lambda: contact_rates(evaluation["collisions"]),
        )  # fmt: skip


@mpl.rc_context(STYLE)
def svg(figure: Figure) -> str:
    """The figure as SVG text, the same for the same data."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()


def _log(ax: Axes) -> None:
    """A log axis with plain numbers (0.05 instead of 5 x 10^-2), at 1, 2, 5 of a decade where few decades are shown."""
    ax.set_yscale("log")
    low, high = ax.get_ylim()
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.yaxis.set_minor_locator(LogLocator(subs=(2, 5) if high / low < 300 else ()))
    ax.yaxis.set_minor_formatter(lambda value, _: f"{value:g}")


def blank_figure(width: float | int, height: float | int) -> Figure:
    """An empty figure of that size [inches]."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure
