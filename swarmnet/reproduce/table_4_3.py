"""Table 4.3: schedules of swarm sizes on Boids, such as 5->5-10: trained on 5, then tuned on a mix of 5 and 10."""

from dataclasses import replace
from pathlib import Path

from envs.config import SimulateConfig
from gnn.checkpoint import Model
from gnn.schedule import EDGES, parse_schedule, schedule_name
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.lock import locked
from swarmnet.reproduce.work import demonstrations, errors, few, trained, unseen

WORLD = SimulateConfig(preset="published")
SIZES, HORIZON = (3, 5, 7, 10, 20), 40
COLUMNS = tuple(f"N={size}" for size in SIZES)
THESIS = {
    "5": (0.58, 0.14, 0.48, 1.66, 9.6),
    "10": (1.96, 0.93, 0.50, 0.41, 1.69),
    "20": (3.01, 1.78, 1.31, 0.86, 0.64),
    "5->10": (9.04, 1.50, 0.42, 0.29, 1.68),
    "5->5-10": (0.69, 0.13, 0.33, 0.28, 1.74),
    "10->20": (13.1, 6.21, 3.41, 1.36, 0.62),
}


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains or tunes, and tests on every size."""
    model = scheduled(cell, effort, folder, progress)
    found = {}
    for size, column in zip(SIZES, COLUMNS, strict=True):
        found |= errors(model, unseen(replace(WORLD, num_agents=size), few(effort, size)), (HORIZON,), (column,))
    return found


def scheduled(cell: Cell, effort: Effort, folder: Path, progress: Update) -> Model:
    """The model of a schedule; all but its last stage are the cell of a row of their own, trained there if need be."""
    *before, sizes = parse_schedule(cell.row)
    initial = None
    if before:
        first = replace(cell, row=schedule_name(tuple(before)))
        place = first.path(folder.parents[2])
        with locked(place / "cell.lock"):
            initial = scheduled(first, effort, place, progress)
    share = replace(effort, demonstrations=effort.demonstrations // len(sizes))
    data = [demonstrations(replace(WORLD, num_agents=size), share, cell.seed) for size in sizes]
    freeze = EDGES if before else ()
    return trained("best", data, effort, folder, progress, seed=cell.seed, initial=initial, freeze=freeze)


TABLE_4_3 = Experiment(
    name="table-4.3",
    about="schedules of swarm sizes on Boids (5, 10, 20, 5->10, 5->5-10, 10->20), error for 3 to 20 agents",
    rows=tuple(THESIS),
    data_sets=(DataSet("boids", COLUMNS),),
    run=run,
    references={(row, column): v for row, all_v in THESIS.items() for column, v in zip(COLUMNS, all_v, strict=True)},
    notes="Error at 40 steps. A tuned row spends its minutes on tuning alone, with the weights of the edge functions "
    "locked; a mixed stage learns from as many runs in all as any other.",
)
