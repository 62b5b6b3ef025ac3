"""Section 4.1's argument: which way of joining messages carries a law over to other sizes.

Superposed accelerations (Boids, chasers in the code's law) ask for sums, averages (Vicsek, chasers in the text's law)
for means. Every way is trained on one size of swarm and tested on half, twice and four times that size.
"""

from dataclasses import replace
from pathlib import Path

from envs.config import SimulateConfig
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.work import demonstrations, errors, few, trained, unseen

MODELS = {"all": "best-all", "sum": "best-sum", "mean": "best-mean", "max": "best-max"}
TRAINED, SIZES, HORIZON = 10, (5, 10, 20, 40), 40
WORLDS = {
    "boids": SimulateConfig(preset="published"),
    "chaser": SimulateConfig(preset="chaser", average=True, assignment="scene"),
    "chaser sum law": SimulateConfig(preset="chaser", assignment="scene"),
    "vicsek": SimulateConfig(preset="vicsek"),
}


def columns(data: str) -> tuple[str, ...]:
    """Columns of a data set, such as `boids N=5`."""
    return tuple(f"{data} N={size}" for size in SIZES)


def sized(world: SimulateConfig, agents: int) -> SimulateConfig:
    """The world with this many agents; chasers have 1 to N - 1 targets."""
    return replace(world, num_agents=agents, targets=agents - 1 if world.preset == "chaser" else None)


def run(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains on ten agents, tests on every size."""
    world = WORLDS[cell.data]
    data = demonstrations(sized(world, TRAINED), effort, cell.seed)
    model = trained(MODELS[cell.row], data, effort, folder, progress, seed=cell.seed)
    found = {}
    for size, column in zip(SIZES, columns(cell.data), strict=True):
        found |= errors(model, unseen(sized(world, size), few(effort, size)), (HORIZON,), (column,))
    return found


AGGREGATION = Experiment(
    name="aggregation",
    about="messages joined by sum, mean, max and all of them: trained on 10 agents, tested on 5 to 40 (section 4.1)",
    rows=tuple(MODELS),
    data_sets=tuple(DataSet(name, columns(name)) for name in WORLDS),
    run=run,
    notes="Error at 40 steps. Chasers have 1 to N - 1 targets, drawn for each scene.",
)
