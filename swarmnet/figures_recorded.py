"""What a model predicts of recorded trajectories, drawn over what happened: figures and videos of sample windows."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from envs.storage import read_header
from swarmnet.figures import (
    BASELINES,
    MODEL,
    NARROW,
    STYLE,
    FigureFile,
    blank_figure,
    load_pair,
    paths_over_paths,
    read_evaluation,
    svg,
)
from swarmnet.film import Look
from swarmnet.progress import progress
from swarmnet.results import write_whole
from swarmnet.videos import make_video

TITLES = ("recorded", "predicted")
"""Above the panels of a video."""


def displacement_by_step(prediction: dict[str, dict], *, dt: float) -> Figure:
    """Distance between predicted and true position [m] after each time ahead. `prediction`: as in evaluation.json."""
    figure = blank_figure(NARROW, 3.7)
    ax = figure.subplots()
    for (name, error), (color, line) in zip(prediction.items(), ((MODEL, "-"), *BASELINES), strict=False):
        metres = np.asarray(error["displacement"], float)
        ax.plot(dt * np.arange(len(metres) + 1), [0, *metres], color=color, linestyle=line, label=name, gid=name)
    ax.set(xlabel="time ahead [s]", ylabel="displacement error [m]")
    ax.set_xlim(left=0)
    ax.set_ylim(bottom=0)
    figure.legend(loc="outside upper left", ncols=3, columnspacing=1.2, handlelength=1.6)
    return figure


@mpl.rc_context(STYLE)
def make_recorded_figures(run: str | Path) -> list[FigureFile]:
    """Writes RUN/figures/displacement.svg and windows.svg, where a model's prediction of recordings was judged."""
    run, made = Path(run), []
    evaluation = read_evaluation(run)
    if evaluation is None or not evaluation.get("data") or not evaluation["prediction"]:
        return made
    folder, dt = run / "figures", evaluation["dt"]
    write_whole(folder / "displacement.svg", svg(displacement_by_step(evaluation["prediction"], dt=dt)))
    made.append(
        FigureFile(
            folder / "displacement.svg", "Displacement error",
            f"Distance between predicted and recorded position, mean over all agents of all windows of "
            f"`{evaluation['data']}` that are there until then; predicted without ever being corrected.",
        )
    )  # fmt: skip
    pair = load_pair(run, "truth", "predicted")
    if pair is not None:
        truth, predicted = pair
        titles = [f"window {number}" for number in range(1, len(truth) + 1)]
        paths = [folder / "windows.svg", folder / "windows-narrow.svg"]
        for path, columns in zip(paths, (4, 2), strict=True):
            write_whole(path, svg(paths_over_paths(predicted, truth, titles, columns=columns)))
        seconds = truth.dt * (truth.position.shape[1] - 1)
        made.append(
            FigureFile(
                paths[0], "Predicted over recorded",
                "Colour: what the model predicts from the states at the open circles on, arrowheads in the direction "
                f"of time. Grey, dashed: the recording, those who come later included. {seconds:.3g} s each, rows "
                f"{truth.dt:g} s apart.",
                paths[1],
            )
        )  # fmt: skip
    return made


def show_windows(run: str | Path, count: int) -> None:
    """Writes RUN/videos/window-K.mp4, recorded beside predicted, for the first `count` sample windows."""
    run = Path(run)
    files = [run / "rollouts" / "truth.h5", run / "rollouts" / "predicted.h5"]
    for name in ("window-*", "scene-*", "worst-*"):  # of an earlier judgement
        for old in (run / "videos").glob(name):
            old.unlink()
    with progress("videos") as update:
        shown = min(count, read_header(files[0]).scenes)
        for number in range(shown):
            out = run / "videos" / f"window-{number + 1}.mp4"
            make_video(files, out, scenes=[number], titles=TITLES, look=Look(speed=1))
            update(number + 1, shown)
