"""Table 3.2: from Kipf's network to SwarmNet, part by part, on Boids."""

from pathlib import Path

from swarmnet.progress import Update
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.table_3_1 import WORLDS
from swarmnet.reproduce.work import SLOWLY, demonstrations, errors, unseen

MODELS = {
    "swarmnet best": "best",
    "swarmnet thesis-ch3 context": "thesis-ch3",
    "kipf": "kipf",
    "kipf-decoder": "kipf-decoder",
    "kipf-decoder-context": "kipf-decoder-context",
    "kipf-decoder-conv1d": "kipf-decoder-conv1d",
    "kipf-decoder-conv1d-context": "kipf-decoder-conv1d-context",
}
HORIZONS = (5, 40)
COLUMNS = ("boids 5", "boids 40")
THESIS = {
    "swarmnet best": (0.2338, 2.778),
    "swarmnet thesis-ch3 context": (0.2338, 2.778),
    "kipf": (0.4288, 17.45),
    "kipf-decoder": (0.2654, 3.639),
    "kipf-decoder-context": (0.2717, 3.873),
    "kipf-decoder-conv1d": (0.2584, 3.916),
    "kipf-decoder-conv1d-context": (0.2491, 3.101),
}


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains one member of the row of networks and tests it on unseen runs."""
    world = WORLDS["boids"]  # table 3.1's, whose networks need not be trained twice
    learning = Learning(model=MODELS[cell.row], seed=cell.seed)
    model = trained_once(learning, demonstrations(world, effort, cell.seed), effort, folder, progress)
    return errors(model, unseen(world, effort), HORIZONS, COLUMNS)


TABLE_3_2 = Experiment(
    name="table-3.2",
    about="ablation on Boids: Kipf's network, its decoder with context and Conv1D, SwarmNet",
    rows=tuple(MODELS),
    data_sets=(DataSet("boids", COLUMNS),),
    run=run,
    references={(row, column): v for row, both in THESIS.items() for column, v in zip(COLUMNS, both, strict=True)},
    leading=("swarmnet best",),
    notes=SLOWLY,
)
