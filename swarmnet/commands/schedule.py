"""`swarmnet schedule`: one model over swarms of several sizes, tested on sizes it has not seen."""

from functools import cache
from pathlib import Path

from envs.config import SimulateConfig
from envs.simulate import simulate
from envs.storage import load
from envs.trajectories import Trajectories
from gnn.checkpoint import Model
from gnn.config import TrainConfig
from gnn.evaluate import prediction_error
from gnn.schedule import beginnings, parse_schedule, run_schedule, schedule_name
from swarmnet.commands.train import note
from swarmnet.config import Schedule, part_of
from swarmnet.progress import progress
from swarmnet.reproduce.table_4_3 import HORIZON, SIZES, THESIS
from swarmnet.results import Results, Row, write_results

HORIZONS = (5, 40)
TEST_SEED = 1_000_000
"""Added to the seed of the training data."""


def run(config: Schedule) -> int:
    """Simulates what is missing, trains every stage, tests and prints."""
    stages = parse_schedule(config.schedule)
    with progress(f"train {schedule_name(stages)}") as update:
        models = run_schedule(
            stages,
            cache(lambda size: recordings(config, size)),
            part_of(TrainConfig, config).scaled(config.scale),
            config.run,
            minutes=config.minutes,
            freeze=config.freeze,
            validation=config.validation,
            progress=lambda name, done, total, row: update(done, total, f"{name}: {note(row)}"),
        )
    names = [schedule_name(beginning) for beginning in beginnings(stages)]
    rows, tests = [], {size: recordings(config, size, test=True) for size in config.test_sizes}
    for name, model in zip(names, models, strict=True):
        with progress(f"test {name}") as update:
            for number, (size, test) in enumerate(tests.items()):
                rows += errors(name, model, size, test, boids=config.preset == "published")
                update(number + 1, len(tests))
    dt = next(iter(tests.values())).dt
    print(table(rows, config.test_sizes, dt))
    if config.json:
        write_results(config.json, Results(name="schedule", rows=rows, dt=dt, seeds=[config.seed]))
    return 0


def recordings(config: Schedule, size: int, *, test: bool = False) -> Trajectories:
    """Scenes of one swarm size, simulated once and kept in the run folder."""
    path = Path(config.run) / "data" / f"{'test' if test else 'train'}-{size}.h5"
    simulated = SimulateConfig(
        preset=config.preset,
        num_agents=size,
        scenes=config.test_scenes if test else config.scenes,
        steps=config.steps_per_scene,
        dt=config.dt,
        seed=config.seed + (TEST_SEED if test else 0),
        engine=config.engine,
    )
    with progress(f"simulate {path.stem}") as update:
        simulate(simulated, path, progress=update)
    return load(path)


def errors(name: str, model: Model, size: int, test: Trajectories, *, boids: bool = True) -> list[Row]:
    """The published error of a model on one size at every horizon that the scenes are long enough for.

    Each horizon for itself: together, every window would be predicted to the longest.
    """
    rows, window = [], model.config.window
    for horizon in HORIZONS:
        if window + horizon > test.position.shape[1]:
            continue
        found = prediction_error(model.predict, model.params, test, window=window, horizons=(horizon,))
        reference = None
        if boids and horizon == HORIZON and name in THESIS and size in SIZES:
            reference = THESIS[name][SIZES.index(size)]
        column = f"N={size} {horizon} steps"
        rows.append(Row(name, column, found.published_mean[0], reference=reference, unit="normalized MSE"))
    return rows


def table(rows: list[Row], sizes: tuple[int, ...], dt: float) -> str:
    """Errors by schedule and horizon, a column for each size; the thesis's beside ours where it has the schedule."""
    lines = [f"published error (normalized MSE, mean over windows), dt {dt} s, by number of agents:"]
    lines.append(f"{'schedule':20} {'steps':>5} " + "".join(f"{size:>10}" for size in sizes))
    found = {(row.row, row.column): row for row in rows}
    for name in dict.fromkeys(row.row for row in rows):
        for horizon in HORIZONS:
            cells = [found.get((name, f"N={size} {horizon} steps")) for size in sizes]
            if not any(cells):
                continue
            values = "".join(f"{cell.value:10.4g}" if cell else f"{'-':>10}" for cell in cells)
            lines.append(f"{name:20} {horizon:5d} " + values)
            if any(cell and cell.reference is not None for cell in cells):
                theirs = [cell.reference if cell else None for cell in cells]
                printed = "".join(f"{'-':>10}" if value is None else f"{value:10.4g}" for value in theirs)
                lines.append(f"{'  thesis, table 4.3':20} {horizon:5d} " + printed)
    return "\n".join(lines)
