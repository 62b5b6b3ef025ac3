"""`swarmnet demo`: the main job, each part kept when it is done."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path

from envs.config import SimulateConfig
from envs.plain import plain
from envs.simulate import simulate
from envs.storage import load
from gnn.checkpoint import load_model
from gnn.config import TrainConfig, model_preset
from gnn.train import train
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.commands.train import note
from swarmnet.config import Demo
from swarmnet.judge import judge
from swarmnet.progress import progress
from swarmnet.report import write_report
from swarmnet.results import write_whole
from swarmnet.videos import make_videos

TEST_SEED = 1_000_000
"""Added to the seed: the test scenes' own."""


def run(config: Demo) -> int:
    """Does what is missing in runs/NAME and says what came out."""
    if not model_preset(config.model).acts:
        raise SpecError("model", config.model, "one that steers, such as thesis-ch5 or best: others only predict")
    if config.scenes < 2:
        raise SpecError("scenes", config.scenes, "at least 2: one is kept for validation")
    world = SimulateConfig(preset="clear", scenes=config.scenes, seed=config.seed, engine=config.engine)
    unseen = replace(world, scenes=config.test_scenes, seed=config.seed + TEST_SEED)
    training = TrainConfig(model=config.model, seed=config.seed).scaled(config.scale)
    started = time.monotonic()
    folder = Path("runs") / config.name
    _claim(folder, config)
    with progress("1/4 simulate") as update:
        simulate(world, folder / "data.h5", progress=update)
    data = load(folder / "data.h5")
    kept = max(1, len(data) // 20)
    with progress("2/4 train") as update:
        train(
            training,
            data.take(slice(kept, None)),
            folder,
            validation=data.take(slice(0, kept)),
            progress=lambda done, total, row: update(done, total, note(row)),
        )
    judged, name = folder / "evaluation.json", f"swarmnet {config.model}"
    if not _judged(judged, unseen, name):
        judgement = judge(load_model(folder / "checkpoints"), unseen, folder, name=name, label="3/4 ")
        write_whole(judged, json.dumps(judgement.plain(), indent=1))
    with progress("4/4 videos") as update:
        make_videos(folder, config.videos, progress=update)
    report = write_report(folder)
    print(summary(json.loads(judged.read_text()), name))
    print(f"\n{report}  <- open this: figures, tables and videos ({time.monotonic() - started:.0f} s)")
    print(f"videos: {folder / 'videos'}   data: {folder / 'data.h5'}   metrics: {folder / 'metrics.jsonl'}")
    # As it was called: `make demo` leaves no `swarmnet` on the search path.
    program = sys.argv[0] if Path(sys.argv[0]).name == "swarmnet" else "swarmnet"
    print(f"next: {program} evaluate {folder} --scenes 1000 --seed 7   or   {program} --help")
    return 0


def _claim(folder: Path, config: Demo) -> None:
    """Records the settings, or raises SwarmError for a folder that holds a demo of other settings."""
    settings = plain(replace(config, videos=0))
    path = folder / "config.json"
    if path.exists():
        had = json.loads(path.read_text())
        different = [f"{key} {had.get(key)!r} -> {value!r}" for key, value in settings.items() if had.get(key) != value]
        if different:
            raise SwarmError(f"{folder} holds a demo of other settings ({', '.join(different)}); choose another --name")
    write_whole(path, json.dumps(settings, indent=1))


def _judged(path: Path, unseen: SimulateConfig, name: str) -> bool:
    """Whether the demo's own judgement is there, and not that of a later `swarmnet evaluate`."""
    if not path.exists():
        return False
    had = json.loads(path.read_text())
    wanted = (unseen.seed, unseen.scenes, unseen.steps, unseen.preset, {}, {"expert", name})
    found = [had.get(key) for key in ("seed", "scenes", "steps", "preset")]
    return (*found, had.get("asked", {}), set(had.get("collisions", ()))) == wanted


def summary(judgement: dict, name: str) -> str:
    """What came out, in a few lines."""
    expert, learned = judgement["collisions"]["expert"], judgement["collisions"][name]
    error = judgement["prediction"][name]

    def interval(report: dict, figure: str, scale: float = 1.0) -> str:
        value, low, high = (report[figure][key] * scale for key in ("value", "low", "high"))
        return f"{value:.3g} [{low:.3g}, {high:.3g}]"

    errors = ", ".join(
        f"{value:.3g} at {horizon} steps"
        for horizon, value in zip(error["horizons"], error["published_mean"], strict=True)
    )
    ratio = learned["final_goal_distance"]["value"] / expert["final_goal_distance"]["value"]
    return "\n".join(
        (
            f"{judgement['scenes']} unseen scenes, {judgement['steps']} control steps of {judgement['dt']} s in MuJoCo "
            "(value [95% interval])",
            f"  final goal distance   expert {interval(expert, 'final_goal_distance')} m   learned "
            f"{interval(learned, 'final_goal_distance')} m   ratio {ratio:.3f}",
            f"  steps with a contact  expert {interval(expert, 'contact_steps_any', 100.0)} %   learned "
            f"{interval(learned, 'contact_steps_any', 100.0)} %",
            f"  normalized prediction error (published metric)  {errors}",
        )
    )
