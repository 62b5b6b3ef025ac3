"""Figures of reinforcement learning: curves of one training, returns of many beside each other, and what they change.

Returns are those of the policy that explores, mean over the agents of an episode; policies are judged without noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnn.metrics import read_metrics
from swarm_mjcf.errors import SpecError
from swarmnet.figures import BASELINES, EXPERT, MODEL, NARROW, STYLE, FigureFile, blank_figure, svg
from swarmnet.film import Panel
from swarmnet.results import write_whole
from swarmnet.sheets import STYLE as PAPER
from swarmnet.sheets import WIDTHS, sheet

WINDOW = 10
"""Iterations that a smoothed return is the mean of."""
LAST = 0.1
"""Share of the iterations that the final return is the mean of."""
PANELS = (
    ("return of an episode", 1.0, ("return",)),
    ("reward in a control step", 1.0,
     ("reward_goal", "reward_formation", "reward_agent_collision", "reward_solid_collision")),
    ("contact events, 1000 agent-steps", 1000.0, ("contact_events",)),
    ("distance to the goal [m]", 1.0, ("goal_distance",)),
    ("KL from the policy that acted", 1.0, ("kl",)),
    ("clip fraction", 1.0, ("clip_fraction",)),
    ("explained variance of the value", 1.0, ("explained_variance",)),
    ("exploration [limit of action]", 1.0, ("std",)),
)  # fmt: skip
"""Panels of `rl_curves`: title, factor, metrics."""
_GREY = "#8a9099"
_LOOK = {"expert": EXPERT, "imitation": _GREY, "scratch": MODEL} | {
    f"mode {number}": color for number, (color, _) in enumerate(BASELINES)
}


@dataclass(frozen=True)
class History:
    """The smoothed return of one training over its iterations."""

    env_steps: Float[np.ndarray, " I"]
    """Control steps of all scenes so far."""
    minutes: Float[np.ndarray, " I"]
    """Wall time of the iterations so far, compilation included."""
    value: Float[np.ndarray, " I"]
    """NaN before the first episode has ended."""


def history(rows: Sequence[Mapping]) -> History:
    """From the rows of a metrics.jsonl."""
    steps, spent = (np.array([row[name] for row in rows], float) for name in ("env_steps", "spent"))
    return History(steps, spent / 60, smoothed(rows))


def smoothed(rows: Sequence[Mapping], window: int = WINDOW) -> Float[np.ndarray, " I"]:
    """Mean return of the episodes that ended in the last `window` iterations; fewer where there are not as many."""
    episodes = np.array([row["episodes"] for row in rows], float)
    gained = np.where(episodes > 0, [row["return"] for row in rows], 0) * episodes
    total, number = (np.concatenate([[0.0], np.cumsum(x)]) for x in (gained, episodes))
    end = np.arange(1, len(rows) + 1)
    begin = np.maximum(end - window, 0)
    number = number[end] - number[begin]
    return np.where(number > 0, (total[end] - total[begin]) / np.maximum(number, 1), np.nan)


def final_return(rows: Sequence[Mapping]) -> float:
    """Mean return of the episodes that ended in the last tenth of the iterations; NaN where none has."""
    last = max(1, round(LAST * len(rows)))
    return float(smoothed(rows, last)[-1]) if rows else float("nan")


def first_reach(curve: History, target: float) -> float:
    """Env-steps after which the smoothed return is first at least `target`; NaN where it never is."""
    there = np.flatnonzero(curve.value >= target)
    return float(curve.env_steps[there[0]]) if len(there) else float("nan")


def needed(curve: History, scratch: History) -> Float[np.ndarray, " I"]:
    """For every budget that `scratch` had, the share of it after which `curve` first has the return that `scratch` ends
    it with, smoothed likewise; NaN where it never does."""
    best = np.maximum.accumulate(np.where(np.isfinite(curve.value), curve.value, -np.inf))
    at = np.searchsorted(best, scratch.value)  # NaN is sorted behind everything
    reached = np.append(curve.env_steps, np.nan)[at]
    return reached / scratch.env_steps


def together(
    lines: Sequence[tuple[np.ndarray, np.ndarray]], points: int = 200
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "seeds p"]]:
    """Lines (x, y) at common places, as far as all of them go: `(x, y of each)`. NaN in y is passed over."""
    sound = [(x[np.isfinite(y)], y[np.isfinite(y)]) for x, y in lines]
    sound = [line for line in sound if len(line[0])]
    if not sound:
        return np.zeros(0), np.zeros((0, 0))
    places = np.linspace(max(x[0] for x, _ in sound), min(x[-1] for x, _ in sound), points)
    return places, np.stack([np.interp(places, x, y) for x, y in sound])


@mpl.rc_context(PAPER)
def return_history(
    curves: Mapping[str, Mapping[int, History]],
    events: Mapping[str, Sequence[float]],
    *,
    scratch: str = "scratch",
    note: str = "",
) -> Figure:
    """Figure 5.2: smoothed returns over env-steps and over wall time, the share of the env-steps of `scratch` after
    which the others have its return, and contact events of a trajectory as bars.

    Lines are means over seeds, bands and whiskers go from the least to the greatest. What stands behind a comma in a
    name (`mode 0, 10k`) gives line and hatch, in the colour of the name before it.

    Args:
      curves: histories by name and seed.
      events: contact events per trajectory of all seeds by name.
      scratch: name of the curves from random weights, which shares are of.
      note: small print below.

    Raises SpecError when there is nothing to draw.
    """
    if not curves and not events:
        raise SpecError("curves", dict(curves), "histories or contact events of at least one policy")
    figure = blank_figure(WIDTHS["page"], 4.6)
    (over_steps, over_time), (shares, bars) = figure.subplots(2, 2)
    random = curves.get(scratch, {})
    kinds = list(dict.fromkeys(["", *(_kind(name) for name in (*curves, *events))]))
    for name, seeds in curves.items():
        color, style = _color(name), _LINES[kinds.index(_kind(name)) % len(_LINES)]
        pairs = [(one, random[seed]) for seed, one in seeds.items() if seed in random and name != scratch]
        for ax, lines in (
            (over_steps, [(one.env_steps / 1e6, one.value) for one in seeds.values()]),
            (over_time, [(one.minutes, one.value) for one in seeds.values()]),
            (shares, [(other.env_steps / 1e6, needed(one, other)) for one, other in pairs]),
        ):
            x, y = together(lines)
            if len(x):
                ax.fill_between(x, y.min(axis=0), y.max(axis=0), color=color, alpha=0.16, lw=0, gid=f"spread {name}")
                ax.plot(x, y.mean(axis=0), color=color, ls=style, lw=1.2, label=name, gid=name)
    over_steps.set(xlabel="env-steps [million]", ylabel="return of an episode")
    over_time.set(xlabel="wall time [min]")
    shares.set(xlabel=f"env-steps of {scratch} [million]", ylabel="share that gives its return", ylim=(0, 1))
    shares.axhline(0.2, color=_GREY, lw=0.6, ls=":")
    for ax in (over_steps, over_time, shares):
        ax.set_xlim(left=0)
    _bars(bars, events, kinds)
    for ax in (over_steps, over_time, shares, bars):
        ax.grid(axis="y", color="#e4e7ec", lw=0.5)
        ax.set_axisbelow(True)
        ax.spines[["top", "right"]].set_visible(False)
    lines, _ = over_steps.get_legend_handles_labels()
    if lines:
        figure.legend(
            handles=lines, loc="outside lower center", ncols=min(len(lines), 4), frameon=False, handlelength=1.8
        )
    _small_print(figure, note)
    return figure


def _bars(ax: Axes, events: Mapping[str, Sequence[float]], kinds: Sequence[str]) -> None:
    for at, (name, values) in enumerate(events.items()):
        hatch = _HATCHES[kinds.index(_kind(name)) % len(_HATCHES)]
        mean = float(np.mean(values))
        ax.bar(at, mean, color=_color(name), alpha=0.85, hatch=hatch, ec="white", lw=0, gid=f"bar {name}")
        ax.vlines(at, min(values), max(values), color="#22262e", lw=0.8)
        ax.annotate(
            f"{mean:.2g}", (at, max(values)), xytext=(0, 2), textcoords="offset points", ha="center", fontsize=6
        )
    ax.set_xticks(range(len(events)), list(events), rotation=50, ha="right", rotation_mode="anchor")
    ax.set_ylabel("contact events per trajectory")
    ax.margins(y=0.12)
    ax.set_ylim(bottom=0)


_LINES, _HATCHES = ("-", "--", ":"), (None, "////", "....")
"""Of what stands behind a comma in a name, in the order in which it comes; the first is for nothing."""


def _color(name: str) -> str:
    return _LOOK.get(name.partition(",")[0], _GREY)


def _kind(name: str) -> str:
    return name.partition(",")[2].strip()


@mpl.rc_context(PAPER)
def policy_sheet(panels: Sequence[Panel], *, columns: int, width: str = "page", note: str = "") -> Figure:
    """Figures 5.3 and 5.4: what a policy does (colour) over what its reference did from the same start (dashed)."""
    figure = sheet(panels, columns=columns, width=width)
    _small_print(figure, note)
    return figure


def _small_print(figure: Figure, note: str) -> None:
    """Above the legend's entries, in lines as wide as the figure."""
    if note and figure.legends:
        lines = wrap(note, round(18 * figure.get_figwidth()))
        figure.set_figheight(figure.get_figheight() + 0.1 + 0.12 * len(lines))
        figure.legends[0].set_title("\n".join(lines))
        figure.legends[0].get_title().set(fontsize=6, color="#4a505a")


def rl_curves(rows: Sequence[Mapping]) -> Figure:
    """What a training measured, over env-steps: a faint line for each iteration, a strong one for the last ten.

    `rows`: of metrics.jsonl. Means over agents and control steps of an iteration, the return over its episodes.
    """
    figure = blank_figure(NARROW, 8.4)
    axes = figure.subplots(-(-len(PANELS) // 2), 2, sharex=True)
    steps = np.array([row["env_steps"] for row in rows]) / 1e6
    for ax, (title, factor, names) in zip(axes.ravel(), PANELS, strict=True):
        for name, color in zip(names, (MODEL, *(color for color, _ in BASELINES)), strict=False):
            raw = factor * np.array([row[name] for row in rows], float)
            ended = np.array([row["episodes"] for row in rows]) > 0
            raw = np.where(ended | (name != "return"), raw, np.nan)
            smooth = smoothed(rows) if name == "return" else _running(raw)
            label = name.removeprefix("reward_").replace("_", " ")
            ax.plot(steps, raw, color=color, alpha=0.25, linewidth=0.8)
            ax.plot(steps, smooth, color=color, linewidth=1.6, label=label, gid=name)
        if len(names) > 1:
            ax.legend(fontsize=7, handlelength=1.0, labelspacing=0.2)
        ax.set_title(title, fontsize=9)
        ax.tick_params(labelsize=8)
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for ax in axes[-1]:
        ax.set_xlabel("env-steps [million]", fontsize=9)
        ax.set_xlim(left=0)
    return figure


def _running(values: np.ndarray, window: int = WINDOW) -> np.ndarray:
    """Mean of the last `window` values, of fewer at the beginning."""
    total, end = np.concatenate([[0.0], np.cumsum(values)]), np.arange(1, len(values) + 1)
    begin = np.maximum(end - window, 0)
    return (total[end] - total[begin]) / (end - begin)


@mpl.rc_context(STYLE)
def make_rl_figures(run: str | Path) -> list[FigureFile]:
    """Writes RUN/figures/rl.svg, where the folder holds a training by reinforcement."""
    run = Path(run)
    rows = read_metrics(run / "metrics.jsonl")
    if not rows or "env_steps" not in rows[0]:
        return []
    path = run / "figures" / "rl.svg"
    write_whole(path, svg(rl_curves(rows)))
    return [
        FigureFile(
            path, "Reinforcement learning",
            "Over env-steps (control steps of all scenes): a faint line for every iteration, a strong one for the mean "
            f"of the last {WINDOW}. Rewards, contact events and distance are means over agents and control steps, with "
            "exploration; the return is the sum over an episode, mean over its agents.",
        )
    ]  # fmt: skip
