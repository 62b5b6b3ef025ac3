"""`swarmnet bench`: prints `name.metric value` lines; what is compared is measured in the same run."""

import itertools
import math
import re
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax

from envs.config import SimulateConfig
from envs.simulate import simulate_in_memory
from gnn.config import TrainConfig
from gnn.evaluate import constant_velocity, persistence, prediction_error
from gnn.train import train
from swarm_mjcf.build import compile_scene
from swarm_mjcf.spec import SceneSpec
from swarmnet.bench_engines import bench_engines
from swarmnet.bench_experts import bench_experts
from swarmnet.bench_repair import Part, Proof, Rotation, bench_repair, network
from swarmnet.bench_rl import PUBLISHED_RATE, bench_rl
from swarmnet.bench_throughput import bench_throughput
from swarmnet.bench_train import bench_loop, bench_one_core
from swarmnet.commands.train import note
from swarmnet.config import Bench
from swarmnet.figures import svg
from swarmnet.figures_gaps import gaps
from swarmnet.progress import progress
from swarmnet.results import Results, Row, write_results, write_whole

THESIS = {"published_mean 5 steps": 0.2338, "published_mean 40 steps": 2.778}
"""Table 3.1, SwarmNet with context on Boids, after 50K demonstrations."""


def run(config: Bench) -> int:
    """Measures what was asked for."""
    results = _MEASURES[config.what](config)
    if config.json:
        write_results(config.json, results)
    return 0


def _engines(config: Bench) -> Results:
    rows = []
    for rate in bench_engines(config.agents, config.substeps, repeats=config.repeats):
        if isinstance(rate, str):
            print(rate, flush=True)
            continue
        column = f"N={rate.agents} k={rate.substeps}"
        where = f"engines.{rate.case.replace(' + ', '_')}.n{rate.agents}.k{rate.substeps}"
        print(f"{where}.scene_steps_per_second {rate.per_second:.0f}")
        print(f"{where}.ratio_to_bare {rate.ratio:.3f}", flush=True)
        rows.append(Row(rate.case, f"{column} scene-steps/s", rate.per_second, unit="1/s"))
        rows.append(Row(rate.case, f"{column} ratio to bare", rate.ratio, unit="1"))
        rows.append(Row(rate.case, f"{column} scenes", rate.scenes, unit="scenes"))
    return Results(name="bench-engines", rows=rows)


def _experts(config: Bench) -> Results:
    rows = []
    for cell in bench_experts(config.agents, repeats=config.repeats):
        where = f"experts.{cell.expert}.{cell.interaction}.n{cell.agents}".replace(" ", "_")
        figures = (
            ("scene-steps/s", cell.per_second, "1/s"),
            ("cost per agent relative to N=100", cell.cost_per_agent, "1"),
            ("ratio to NumPy", cell.numpy_ratio, "1"),
        )
        for figure, value, unit in figures:
            if math.isnan(value):
                continue
            print(f"{where}.{_metric(figure)} {value:.4g}", flush=True)
            rows.append(Row(f"{cell.expert}, {cell.interaction}", f"N={cell.agents} {figure}", value, unit=unit))
    return Results(name="bench-experts", rows=rows)


def _adapters(config: Bench) -> Results:
    from swarmnet.bench_adapters import bench_adapters  # the libraries that it adapts to are optional

    rows = []
    for cell in bench_adapters(turns=5 * config.repeats):
        where = f"adapters.{cell.adapter}.{cell.policy}.s{cell.scenes}".replace(" ", "_")
        for figure, value, unit in (
            ("scene-steps/s", cell.per_second, "1/s"),
            ("ratio to environment", cell.ratio, "1"),
        ):
            print(f"{where}.{_metric(figure)} {value:.4g}", flush=True)
            rows.append(Row(f"{cell.adapter}, {cell.policy}", f"S={cell.scenes} {figure}", value, unit=unit))
    return Results(name="bench-adapters", rows=rows)


def _metric(figure: str) -> str:
    return re.sub("[^a-z0-9]+", "_", figure.lower())


def _throughput(config: Bench) -> Results:
    rows, device = [], jax.devices()[0]
    print(f"device: {device.device_kind}", flush=True)
    batch = config.batch or ((64, 512) if device.platform == "cpu" else (1024, 4096, 16384, 32768))
    for cell in bench_throughput(config.engine, batch, config.substeps, episodes=2, seed=config.seed):
        column = f"S={cell.scenes} k={cell.substeps}"
        figures = (
            ("scene-steps/s", cell.control_steps_per_second, "1/s"),
            ("physics steps/s", cell.control_steps_per_second * cell.substeps, "1/s"),
            ("compile", cell.compile_seconds, "s"),
            ("agent-states in contact", cell.contact_states, "1"),
            ("scene-states saturated", cell.saturated, "1"),
            ("peak memory", cell.peak_memory, "bytes"),
        )
        for figure, value, unit in figures:
            if value is None:
                continue
            where = f"throughput.{cell.engine}.s{cell.scenes}.k{cell.substeps}"
            print(f"{where}.{_metric(figure)} {value:.4g}", flush=True)
            rows.append(Row(cell.engine, f"{column} {figure}", value, unit=unit))
    return Results(name="bench-throughput", rows=rows, seeds=[config.seed])


def _rl(config: Bench) -> Results:
    rows, device = [], jax.devices()[0]
    print(f"device: {device.device_kind}", flush=True)
    batch = config.batch or ((64, 256, 1024) if device.platform == "cpu" else (1024, 4096, 16384, 32768))
    for cell in bench_rl(batch, seed=config.seed):
        figures = (
            ("engine env-steps/s", cell.engine, "1/s", None),
            ("rollout env-steps/s", cell.rollout, "1/s", None),
            ("update env-steps/s", cell.update, "1/s", None),
            ("training env-steps/s", cell.training, "1/s", PUBLISHED_RATE),
            ("training ratio to engine", cell.training / cell.engine, "1", None),
            ("floor over training", cell.floor / cell.training, "1", None),
            ("floor without ghosts over training", cell.lean_floor / cell.training, "1", None),
            ("operations per env-step", cell.operations, "1", None),
        )
        for figure, value, unit, reference in figures:
            print(f"rl.{cell.network.replace(' ', '_')}.s{cell.scenes}.{_metric(figure)} {value:.4g}", flush=True)
            rows.append(Row(cell.network, f"S={cell.scenes} {figure}", value, reference=reference, unit=unit))
    return Results(name="bench-rl", rows=rows, seeds=[config.seed])


def _imitation(config: Bench) -> Results:
    """Published Boids, contacts off: simulate, train, predict unseen runs."""
    rows: list[Row] = []

    def show(row: str, column: str, value: float | int, unit: str, reference: float | None = None) -> None:
        rows.append(Row(row, column, value, reference=reference, unit=unit))
        metric = f"imitation.{row}.{column}".replace(" ", "_")
        print(f"{metric} {value:.4g}" + ("" if reference is None else f"  (thesis {reference})"), flush=True)

    data = SimulateConfig(preset="published", scenes=config.scenes, seed=config.seed)
    begun = time.monotonic()
    trajectories = simulate_in_memory(data)
    show("simulate", "seconds", time.monotonic() - begun, "s")
    unseen = simulate_in_memory(SimulateConfig(preset="published", scenes=200, seed=config.seed + 1_000_000))
    begun = time.monotonic()
    with tempfile.TemporaryDirectory() as folder, progress("train best") as update:
        model = train(
            TrainConfig(seed=config.seed).scaled(config.scale),
            trajectories,
            Path(folder),
            validation=unseen,
            progress=lambda done, total, row: update(done, total, note(row)),
        )
    show("train", "seconds", time.monotonic() - begun, "s")
    show("train", "runs", config.scenes, "trajectories")
    predictors = {
        "swarmnet best": (model.predict, model.params),
        "constant velocity": (constant_velocity(model.integrator.dt), {}),
        "persistence": (persistence, {}),
    }
    for name, (predict, params) in predictors.items():
        error = prediction_error(predict, params, unseen, window=1)
        for kind in ("published_mean", "published_median", "agents_mean", "agents_median"):
            for horizon, value in zip(error.horizons, getattr(error, kind), strict=True):
                column = f"{kind} {horizon} steps"
                reference = THESIS.get(column) if name.startswith("swarmnet") else None
                show(name, column, value, "normalized MSE", reference)
    return Results(name="bench-imitation", rows=rows, dt=0.3, seeds=[config.seed])


def _train(config: Bench) -> Results:
    """The training loop of two presets, and one core against Keras."""
    data = simulate_in_memory(SimulateConfig(preset="published", scenes=config.scenes, seed=config.seed))
    loops = (
        bench_loop(TrainConfig(model=model, seed=config.seed).scaled(0.1 * config.scale), data)
        for model in ("best", "thesis-ch3")
    )
    rows = []
    for rate in itertools.chain(loops, bench_one_core(config.seed)):
        if isinstance(rate, str):
            print(rate, flush=True)
            continue
        figures = (("windows/s", rate.windows_per_second, "1/s"), ("compiled share", rate.compiled_share, "1"))
        for figure, value, unit in figures:
            if value is not None:
                print(f"train.{_metric(rate.case)}.{_metric(figure)} {value:.4g}", flush=True)
                rows.append(Row(rate.case, figure, value, unit=unit))
    return Results(name="bench-train", rows=rows, dt=0.3, seeds=[config.seed])


def _repair(config: Bench) -> Results:
    """Proofs and parts of repair; their figure goes beside the JSON."""
    rows: list[Row] = []
    proofs: list[Proof] = []
    with tempfile.TemporaryDirectory() as folder, progress("train thesis-ch5-small") as update:
        model = network(config.run, config.seed, config.scenes, Path(folder), update)
    for found in bench_repair(model, config.seconds):
        if isinstance(found, str):
            print(found, flush=True)
        elif isinstance(found, Part):
            print(f"repair.loop.{_metric(found.name)}.seconds {found.seconds:.4g}", flush=True)
            rows.append(Row("parts of the loop, 512 scenes", f"{found.name} seconds", found.seconds, unit="s"))
        elif isinstance(found, Rotation):
            rows += _rotation(found)
        else:
            proofs.append(found)
            rows += _proof(found)
    if config.json:
        write_whole(config.json.with_suffix(".svg"), svg(gaps(proofs)))
    return Results(name="bench-repair", rows=rows, dt=model.integrator.dt, seeds=[config.seed])


def _proof(found: Proof) -> Iterator[Row]:
    column = f"R={found.rows} {found.setting}={found.value:g}"
    where = f"repair.{_metric(found.family)}.r{found.rows}.{found.setting}{found.value:g}"
    rows, columns = found.size or (None, None)
    for figure, value, unit in (
        ("seconds", found.seconds, "s"),
        ("gap [%]", 100 * found.gap, "%"),
        ("incumbent", found.incumbent, ""),
        ("bound", found.bound, ""),
        ("rows", rows, "1"),
        ("columns", columns, "1"),
        ("binaries", found.binaries if found.size else None, "1"),
        ("rows left violated", found.left if found.size else None, "1"),
    ):
        if value is not None:
            print(f"{where}.{_metric(figure.replace('[%]', 'percent'))} {value:.5g}", flush=True)
            yield Row(found.family, f"{column} {figure}", value, unit=unit, more={"status": found.status})


def _rotation(found: Rotation) -> Iterator[Row]:
    where = f"repair.rotation.{_metric(found.layers)}.r{found.rows}.box{found.box:g}"
    for figure, value, unit in (
        ("seconds", found.seconds, "s"),
        ("merit before", found.before, ""),
        ("merit", found.after, ""),
        ("programs", found.steps, "1"),
        ("programs accepted", found.accepted, "1"),
        ("rows violated before", found.broken, "1"),
        ("rows left violated", found.left, "1"),
    ):
        print(f"{where}.{_metric(figure)} {value:.5g}", flush=True)
        yield Row(f"rotation, {found.layers}", f"R={found.rows} box={found.box:g} {figure}", value, unit=unit)


def _build(config: Bench) -> Results:
    """Seconds for 1000 scenes of 20 agents from specification to compiled model, on one core."""
    begun = time.perf_counter()
    for arena in range(1000):  # 1000 different scenes
        compile_scene(SceneSpec(num_agents=20, arena=100.0 + arena))
    seconds = time.perf_counter() - begun
    print(f"build.seconds_per_1000_scenes_of_20 {seconds:.3f}")
    row = Row("build", "seconds per 1000 scenes of 20 agents", seconds, unit="s")
    return Results(name="bench-build", rows=[row])


def _rendering(config: Bench) -> Results:
    from swarm_mjcf.render_bench import run as bench_rendering

    rows = [Row("render", metric, value) for metric, value in bench_rendering()]
    for row in rows:
        print(f"{row.column} {row.value:.4g}")
    return Results(name="bench-rendering", rows=rows)


_MEASURES = {
    "engines": _engines,
    "experts": _experts,
    "adapters": _adapters,
    "throughput": _throughput,
    "imitation": _imitation,
    "train": _train,
    "rl": _rl,
    "repair": _repair,
    "rendering": _rendering,
    "build": _build,
}
