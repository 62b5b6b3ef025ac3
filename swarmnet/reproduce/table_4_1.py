"""Table 4.1: trained on ten agents alone, tested on five, ten and twenty; beyond it, on a crowd of two hundred."""

from dataclasses import replace
from pathlib import Path

from envs.config import SimulateConfig, make_world
from envs.noise import ActuationNoise
from gnn.laws import law_predict
from swarmnet.progress import Update
from swarmnet.reproduce.borrow import Learning, trained_once
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.work import SLOWLY, demonstrations, errors, few, published_mean, unseen

MODELS = {
    "swarmnet best": "best",
    "swarmnet thesis-ch3 context": "thesis-ch3",
    "kipf": "kipf",
    "seq2seq": "seq2seq",
}
WORLDS = {"boids": "published", "helbing": "helbing"}
TRAINED, SIZES, HORIZON = 10, (5, 10, 20), 40
CROWD, CROWD_SHARE = 200, 64
"""Agents of the crowd, and the share of its unseen scenes: each has as many pairs as 400 scenes of ten."""
CROWDED = {f"{data} crowd": data for data in WORLDS}
NOISY = {"law, noise 0.03": 0.03, "law, noise 0.1": 0.1}
"""The expert itself with normal noise on every acceleration [m/s^2]: how far a law carries small errors."""
THESIS = {
    "swarmnet best": {"boids": (0.93, 0.41, 1.69), "helbing": (0.24, 0.05, 0.32)},
    "swarmnet thesis-ch3 context": {"boids": (0.93, 0.41, 1.69), "helbing": (0.24, 0.05, 0.32)},
    "kipf": {"boids": (111.0, 11.7, 1e4), "helbing": (1e4, 10.6, 1e6)},
    "seq2seq": {"boids": (None, 1.45, None), "helbing": (None, 1.50, None)},
}


def columns(data: str) -> tuple[str, ...]:
    """Columns of a data set, such as `boids N=5`."""
    if data in CROWDED:
        return (f"{CROWDED[data]} N={CROWD}",)
    return tuple(f"{data} N={size}" for size in SIZES)


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains on ten agents and tests; a network with one input per agent on ten alone. A law has nothing to learn."""
    world = SimulateConfig(preset=WORLDS[CROWDED.get(cell.data, cell.data)], num_agents=TRAINED)
    tests = {size: few(effort, size) for size in SIZES}
    if cell.data in CROWDED:
        tests = {CROWD: replace(effort, test_scenes=max(1, effort.test_scenes // CROWD_SHARE))}
    if cell.row in NOISY:
        law = law_predict(make_world(world.preset), ActuationNoise(std=NOISY[cell.row]))
        return {
            column: published_mean(law, {}, unseen(replace(world, num_agents=size), scenes), window=1, horizon=HORIZON)
            for (size, scenes), column in zip(tests.items(), columns(cell.data), strict=True)
        }
    learning = Learning(model=MODELS[cell.row], seed=cell.seed)
    model = trained_once(learning, demonstrations(world, effort, cell.seed), effort, folder, progress)
    found = {}
    for (size, scenes), column in zip(tests.items(), columns(cell.data), strict=True):
        if cell.row != "seq2seq" or size == TRAINED:
            found |= errors(model, unseen(replace(world, num_agents=size), scenes), (HORIZON,), (column,))
    return found


TABLE_4_1 = Experiment(
    name="table-4.1",
    about="trained on 10 agents alone, error at 40 steps for 5, 10 and 20 agents, and of ours for 200",
    rows=(*MODELS, *NOISY),
    data_sets=tuple(DataSet(name, columns(name)) for name in (*WORLDS, *CROWDED)),
    run=run,
    exists=lambda row, data: data not in CROWDED or row == "swarmnet best" or row in NOISY,
    references={
        (row, column): value
        for row, by_data in THESIS.items()
        for data, values in by_data.items()
        for column, value in zip(columns(data), values, strict=True)
        if value is not None
    },
    leading=("swarmnet best",),
    untrained=tuple(NOISY),
    notes=(
        f"N={CROWD}: the network of the row's other columns on a {CROWD_SHARE}th of the unseen scenes. {SLOWLY} "
        "Rows `law`: the expert itself, with normal noise of this standard deviation [m/s^2] on its accelerations."
    ),
)
