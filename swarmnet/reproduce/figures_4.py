"""Figures 4.2 to 4.5: networks on swarms of other sizes, before and after tuning all but their edge functions."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from envs.config import SimulateConfig
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.evaluate import natural_change
from gnn.padding import mix
from swarmnet.figures_thesis import Shown, norm_distributions, prediction_sheet
from swarmnet.progress import Update
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.norms import PARTS, norms
from swarmnet.reproduce.shown import STEPS, file_name, first_of_rows, panels, show, small_print, write
from swarmnet.reproduce.work import demonstrations, errors, few, unseen
from swarmnet.results import write_whole

MODELS = {
    "swarmnet best": "best",
    "swarmnet best-mean": "best-mean",
    "swarmnet thesis-ch3": "thesis-ch3",
}
BOIDS_ROWS = ("swarmnet best", "swarmnet thesis-ch3")
CHASER_ROWS = ("swarmnet best-mean", "swarmnet thesis-ch3")
"""`best-mean` joins messages as the averaged law does: the main rows of table 4.2."""
CHASED = (3, 5, 10, 20, 100)
"""Swarm sizes of figure 4.3, every agent after one other."""
PAIRS = ((3, 1), (5, 2), (10, 5), (10, 8), (20, 9), (20, 17))
"""(agents N, targets M) of figures 4.4 and 4.5."""
BOID_PANELS = {"5 boids": 5, "10 boids": 10, "10 boids, tuned on 5 and 10": 10, "5 boids, tuned on 5 and 10": 5}
"""What figure 4.2 measures, with the number of agents; it shows the first three."""
TITLES = {"message": r"output of $\phi^e$", "joined": "messages joined", "output": "output of the network"}
LINES = ("before tuning", "after tuning")
PAIR = (0, 1)
"""The two agents that figure 4.5 shows: the first, whoever they are."""
_KEPT = 20_000
"""Norms of each kind that are kept for drawing."""


def boids(agents: int) -> SimulateConfig:
    """The published Boids."""
    return SimulateConfig(preset="published", num_agents=agents)


def chasers(agents: int, targets: int, *, assignment: str | None = None) -> SimulateConfig:
    """Chasers by the averaged law of the thesis's text, each after `targets` others."""
    return SimulateConfig(preset="chaser", num_agents=agents, targets=targets, assignment=assignment, average=True)


def begun(cell: Cell, data: Trajectories, effort: Effort, folder: Path, progress: Update) -> Model:
    """The row's network before tuning."""
    wanted = Learning(model=MODELS[cell.row], seed=cell.seed, part="start")
    return trained_once(wanted, data, effort, folder, progress)


def tuned(cell: Cell, model: Model, data: Trajectories, effort: Effort, folder: Path, progress: Update) -> Model:
    """The same trained on for as many minutes again, all but its edge functions and the convolutions they see through.

    The thesis locks both (`w`, theta_1), so that messages stay what they were.
    """
    freeze = tuple(f"{part}/*" for part in ("conv", "edge") if part in model.params)
    wanted = Learning(model=MODELS[cell.row], seed=cell.seed, part="tuned", initial=model, freeze=freeze)
    return trained_once(wanted, data, effort, folder, progress)


def look(model: Model, world: SimulateConfig, effort: Effort, folder: Path, name: str) -> dict[str, float]:
    """The columns of a panel: the error over 40 steps on unseen runs, and that of the first, which is kept to be shown.

    Larger swarms are tested on fewer runs (`work.few`).
    """
    test = unseen(world, few(effort, world.num_agents))
    found = show(model, test.take(slice(0, 1)), folder, name, unit=natural_change(test)[0])
    return errors(model, test, (STEPS,), (name,)) | {both(name)[1]: float(found[0])}


def both(name: str) -> tuple[str, str]:
    """Columns of a panel."""
    return name, f"{name}, shown"


def of(agents: int, targets: int) -> str:
    """Name of a panel."""
    return f"N = {agents}, M = {targets}"


def run_4_2(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trained on 5 boids, tuned on 5 and 10 together, padded."""
    five, ten = (demonstrations(boids(n), effort, cell.seed) for n in (5, 10))
    start = begun(cell, five, effort, folder, progress)
    after = tuned(cell, start, _in_turn([five, ten]), effort, folder, progress)
    found: dict[str, float] = {}
    for (name, agents), model in zip(BOID_PANELS.items(), (start, start, after, after), strict=True):
        found |= look(model, boids(agents), effort, folder, name)
    return found


def _in_turn(parts: Sequence[Trajectories]) -> Trajectories:
    """The first half of each part, padded and shuffled together: the first scenes of all are those of validation."""
    mixed = mix([part.take(slice(0, (len(part) + 1) // 2)) for part in parts])
    return mixed.take(np.random.default_rng(0).permutation(len(mixed)))


def draw_4_2(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """The thesis's three panels."""
    return _sheets(folder, done, FIGURE_4_2, list(BOID_PANELS)[:3], columns=3, about="boids")


def run_4_3(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trained on 3 chasers, used on more."""
    model = begun(cell, demonstrations(chasers(3, 1), effort, cell.seed), effort, folder, progress)
    found: dict[str, float] = {}
    for agents in CHASED:
        found |= look(model, chasers(agents, 1), effort, folder, of(agents, 1))
    return found


def draw_4_3(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """A panel for each size."""
    names = [of(agents, 1) for agents in CHASED]
    return _sheets(folder, done, FIGURE_4_3, names, columns=5, about="chasers, trained on N = 3, M = 1")


def grown(cell: Cell, effort: Effort, folder: Path, progress: Update) -> tuple[Model, Model]:
    """Trained on (3, 1), and tuned on ten agents that chase 1 to 9 others, scene by scene."""
    start = begun(cell, demonstrations(chasers(3, 1), effort, cell.seed), effort, folder, progress)
    many = demonstrations(chasers(10, 9, assignment="scene"), effort, cell.seed)
    return start, tuned(cell, start, many, effort, folder, progress)


def run_4_4(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Keeps norms for the figure; the columns are their medians."""
    found, kept = {}, {}
    for line, model in zip(LINES, grown(cell, effort, folder, progress), strict=True):
        for pair in PAIRS:
            test = unseen(chasers(*pair), few(effort, pair[0]))
            for part, lengths in norms(model, test).items():
                found[median_of(line, part, pair)] = float(np.median(lengths))
                kept[median_of(line, part, pair)] = lengths[:: -(-len(lengths) // _KEPT)].astype(np.float32)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **kept)
    write_whole(folder / "norms.npz", buffer.getvalue())
    return found


def median_of(line: str, part: str, pair: tuple[int, int]) -> str:
    """A column of figure 4.4."""
    return f"{part} {pair[0]},{pair[1]} {line}"


def draw_4_4(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Distributions before and after tuning."""
    files = []
    for row, (cell, record) in first_of_rows(done).items():
        with np.load(cell.path(folder) / "norms.npz", allow_pickle=False) as kept:
            shown = {
                line: {
                    title: {str(pair): kept[median_of(line, part, pair)] for pair in PAIRS}
                    for part, title in TITLES.items()
                }
                for line in LINES
            }
        figure = norm_distributions(shown, note=f"{row}, chasers (N, M), {small_print(record)}")
        files += write(folder, file_name(FIGURE_4_4, row), figure)
    return files


def run_4_5(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """The tuned network on chasers of several sizes and neighbourhoods."""
    _, model = grown(cell, effort, folder, progress)
    found: dict[str, float] = {}
    for pair in PAIRS:
        found |= look(model, chasers(*pair), effort, folder, of(*pair))
    return found


def draw_4_5(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Two agents of each swarm."""
    names, about = [of(*pair) for pair in PAIRS], "chasers, trained on (3, 1), tuned on N = 10, two agents shown"
    return _sheets(folder, done, FIGURE_4_5, names, columns=3, about=about, agents=PAIR)


def _sheets(
    folder: Path, done: Sequence[tuple[Cell, dict]], experiment: Experiment, names: Sequence[str], *, columns: int,
    about: str, agents: tuple[int, ...] | None = None,
) -> list[Path]:  # fmt: skip
    """A figure for each row; its panels are those kept under the names."""
    files = []
    for row, (cell, record) in first_of_rows(done).items():
        shown: list[Shown] = []
        for name in names:
            shown += panels(cell.path(folder), name, [name], agents=agents)
        note = f"{row}, {about}, {small_print(record)}"
        files += write(folder, file_name(experiment, row), prediction_sheet(shown, columns=columns, note=note))
    return files


_SHOWN = f"Published error over {STEPS} steps: mean over all windows of the unseen runs, and of the one scene shown."
_LAW = "Chasers by the averaged law of the text."
_TWICE = (
    "Tuning takes as many minutes as the training before it, and leaves convolutions and edge functions as they are."
)
FIGURE_4_2 = Experiment(
    name="figure-4.2",
    about="5 and 10 boids by a network trained on 5, and 10 after tuning on padded data of 5 and 10",
    rows=BOIDS_ROWS,
    data_sets=(DataSet("boids", tuple(column for name in BOID_PANELS for column in both(name))),),
    run=run_4_2,
    leading=BOIDS_ROWS[:1],
    notes=f"{_SHOWN} {_TWICE}",
    figure=draw_4_2,
)
FIGURE_4_3 = Experiment(
    name="figure-4.3",
    about="chasers N = 3, 5, 10, 20, 100 by a network trained on N = 3",
    rows=CHASER_ROWS,
    data_sets=(DataSet("chaser", tuple(column for n in CHASED for column in both(of(n, 1)))),),
    run=run_4_3,
    leading=CHASER_ROWS[:1],
    notes=_SHOWN,
    figure=draw_4_3,
)
FIGURE_4_4 = Experiment(
    name="figure-4.4",
    about="distributions of norms: messages, messages joined, the output, by (N, M), before and after tuning",
    rows=CHASER_ROWS,
    data_sets=(
        DataSet("chaser", tuple(median_of(line, part, pair) for line in LINES for part in PARTS for pair in PAIRS)),
    ),
    run=run_4_4,
    leading=CHASER_ROWS[:1],
    unit="median norm",
    notes=f"{_LAW} {_TWICE} Messages are joined by mean in best-mean, by sum in thesis-ch3; the output is an "
    "acceleration [m/s^2], of thesis-ch3 a change of the state.",
    figure=draw_4_4,
)
FIGURE_4_5 = Experiment(
    name="figure-4.5",
    about="chasers of several (N, M) after tuning",
    rows=CHASER_ROWS,
    data_sets=(DataSet("chaser", tuple(column for pair in PAIRS for column in both(of(*pair)))),),
    run=run_4_5,
    leading=CHASER_ROWS[:1],
    notes=f"{_LAW} {_SHOWN} {_TWICE}",
    figure=draw_4_5,
)
