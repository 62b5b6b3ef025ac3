"""Collective motion over time, policy against reference: median and the band from 10 to 90% of the scenes."""

import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from envs.collective import UNITS, collective_measures
from envs.storage import load
from swarmnet.figures import EXPERT, MODEL, NARROW, STYLE, WIDE, FigureFile, blank_figure, read_evaluation, svg
from swarmnet.results import write_whole

LABELS = {
    "polarisation": "polarisation",
    "milling": "milling",
    "angular_momentum": "angular momentum",
    "spread": "spread, mean",
    "spread_rms": "spread, RMS",
    "nearest_neighbour_mean": "neighbour, mean",
    "nearest_neighbour_min": "neighbour, least",
}
"""Of the axes, for each measure of `envs.collective.UNITS`."""
DPI = 200
"""Of PNG files, for papers."""
Measures = dict[str, Float[np.ndarray, "S T"]]


def measures_over_time(
    runs: dict[str, Measures], *, dt: float | int, names: tuple[str, ...] = tuple(UNITS), columns: int = 1
) -> Figure:
    """A panel for each measure in `names`; `runs` maps a row's name to its measures, the reference first.

    Scenes in which a measure is undefined at a row are left out there; a row without any leaves a gap.
    """
    lines = -(-len(names) // columns)
    figure = blank_figure(NARROW if columns <= 2 else WIDE, 2.9 if lines == columns == 1 else 0.5 + 2.15 * lines)
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    styles = ((EXPERT, "--"), (MODEL, "-"))[-len(runs) :]
    for panel, name in zip(panels, names, strict=False):
        for (row, measures), (color, line) in zip(runs.items(), styles, strict=True):
            _band(panel, measures[name], dt, color=color, line=line, label=row if panel is panels[0] else f"_{row}")
        unit = UNITS[name]
        label = LABELS[name] + (f" [{unit}]" if unit else "")
        if lines == columns == 1:
            panel.set_ylabel(label)
        else:
            panel.set_title(label, pad=4, fontsize=10)
        panel.set_ylim(0, None if unit else 1.02)
        panel.set_xlim(left=0)
    for panel in panels[len(names) :]:
        panel.set_axis_off()
    for panel in panels[max(0, len(names) - columns) : len(names)]:
        panel.set_xlabel("time [s]")
    figure.legend(loc="outside upper left", ncols=2)
    return figure


def _band(ax: Axes, values: Float[np.ndarray, "S T"], dt: float | int, *, color: str, line: str, label: str) -> None:
    low, middle, high = quantiles(values, (0.1, 0.5, 0.9))
    time = dt * np.arange(values.shape[1])
    ax.fill_between(time, low, high, color=color, alpha=0.16, linewidth=0, gid=f"band {label.lstrip('_')}")
    ax.plot(time, middle, color=color, linestyle=line, label=label, gid=label.lstrip("_"))


def quantiles(values: Float[np.ndarray, "S T"], shares: tuple[float, ...]) -> Float[np.ndarray, "Q T"]:
    """Quantiles over the scenes in which the value is defined; NaN at rows where it is in none."""
    found = np.full((len(shares), values.shape[1]), np.nan)
    for t, column in enumerate(values.T):
        if (defined := column[~np.isnan(column)]).size:
            found[:, t] = np.quantile(defined, shares)
    return found


@mpl.rc_context(STYLE)
def make_collective_figures(run: str | Path) -> list[FigureFile]:
    """Writes RUN/figures/collective.svg and a PNG for each measure, where a policy was judged in closed loop."""
    run = Path(run)
    evaluation = read_evaluation(run)
    if evaluation is None or not evaluation.get("collective"):
        return []
    runs: dict[str, Measures] = {}
    dt = evaluation["dt"]
    for name, file in ((evaluation["reference"], "expert.h5"), (evaluation["policy"], "learned.h5")):
        path = run / "rollouts" / file
        if name is None or not path.exists():
            continue
        runs[name] = collective_measures(load(path))
    if not runs:
        return []
    folder = run / "figures"
    since = max(path.stat().st_mtime_ns for path in [run / "evaluation.json", *(run / "rollouts").glob("*.h5")])
    for name in UNITS:
        path = folder / f"collective-{name}.png"
        if not path.exists() or path.stat().st_mtime_ns < since:  # a report is often written anew from the same data
            write_whole(path, png(measures_over_time(runs, dt=dt, names=(name,))))
    paths = [folder / "collective.svg", folder / "collective-narrow.svg"]
    for path, columns in zip(paths, (4, 2), strict=True):
        write_whole(path, svg(measures_over_time(runs, dt=dt, columns=columns)))
    caption = (
        f"Median over {evaluation['scenes']} scenes at every control step of {dt:g} s; the bands hold the middle 80% "
        "of the scenes. `polarisation`, `milling` and `angular momentum` lie between 0 and 1. Each measure alone, as "
        "PNG, is in figures/collective-*.png. Spread: distance to the centroid; neighbour: the nearest."
    )
    return [FigureFile(paths[0], "Collective motion over time", caption, paths[1])]


@mpl.rc_context(STYLE)
def png(figure: Figure) -> bytes:
    """The figure as PNG bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, metadata={"Software": None})
    return buffer.getvalue()
