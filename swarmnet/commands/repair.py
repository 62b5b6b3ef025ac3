"""`swarmnet repair`."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from envs.plain import plain
from envs.simulate import with_noise
from gnn.checkpoint import Checkpoints, Model, load_model
from gnn.decode import make_policy
from gnn.train import fingerprint
from repair.config import LoopConfig
from repair.linearise import FreeWeights
from repair.loop import Repaired, contacts, repair
from repair.lost import lost
from repair.network import Situations, check_encodable, concatenate, fitted
from repair.verify import clopper_pearson
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.acting import make_perform
from swarmnet.commands import evaluate
from swarmnet.commands.certify import unpacked
from swarmnet.config import Evaluate, part_of
from swarmnet.config_repair import Repair
from swarmnet.judge import training_world
from swarmnet.progress import progress
from swarmnet.results import commit, hardware, write_whole

SCENES = 2_000_000
"""Seed of the scenes that repair acts in; data, training and judging have others."""


def run(config: Repair) -> int:
    """Repairs, saves, and judges both policies on the same unseen scenes."""
    if config.run.resolve() == config.init.resolve():
        raise SpecError("run", str(config.run), "another folder than the one of the model that is repaired")
    model = load_model(config.init / "checkpoints")
    check_encodable(model)
    if config.polish:
        FreeWeights.matching(model.params, config.polish)  # not only when it comes to that
    asked = {name: value for name in ("num_agents", "num_obstacles") if (value := getattr(config, name)) is not None}
    simulated = replace(training_world(model), engine=config.engine, **asked)
    world, how = simulated.world(), part_of(LoopConfig, config)
    least = {name: value for name in ("min_agents", "min_obstacles") if (value := getattr(config, name)) is not None}
    world = replace(world, spawn=replace(world.spawn, **least))
    if world.spawn.targets:
        raise SpecError("init", str(config.init), "a model of a world without targets: of others, chasers hear nothing")
    examples = concatenate_fitted([unpacked(path) for path in config.examples])
    # The noise of the training world is on what it perceives and does here too; what is repaired is what it decides
    # in the states that it comes to.
    policy = with_noise(make_policy(model.config, model.scales, goal=world.scene.goal), simulated)
    perform = make_perform(
        model, world, scenes=how.scenes, steps=how.steps, seed=SCENES + how.seed, engine=config.engine, policy=policy
    )
    _claim(config.run, how, model, asked | least | {"examples": [str(path) for path in config.examples]})
    if _done(config.run):
        print(f"{config.run}: was repaired already")
    else:
        with progress(f"repair by {how.method}") as update:

            def report(done: int, total: int, row: dict) -> None:
                update(done, total, note(row))

            try:
                found = repair(
                    model, how, world.scene, perform, folder=config.run / "rounds", progress=report, examples=examples
                )
            except SwarmError:
                _release(config.run)
                raise
        # The best round was chosen by its scenes; what it is worth is for others to say.
        acted = perform(found.params, how.rounds + 2)
        touched = (np.asarray(acted.touching_agent) | np.asarray(acted.touching_obstacle)).any(axis=(1, 2))
        fresh = contacts(acted) | {"lost": int((touched & lost(acted, world.scene, world.scene)).sum())}
        keep(config.run, model, how, found, fresh)
        print(words(found, how, fresh))
    if not config.test_scenes:
        return 0
    both = {"run": config.run, "reference": str(config.init), "engine": config.engine}
    return evaluate.run(Evaluate(**both, **asked, scenes=config.test_scenes, videos=config.videos))


def concatenate_fitted(parts: list[Situations]) -> Situations | None:
    """Situations of several files, which may have unlike numbers of places; None of no file."""
    if not parts:
        return None
    roomiest = max(parts, key=lambda part: sum(places.shape[1] for places in part.senders.values()))
    return concatenate([fitted(part, roomiest) for part in parts])


def note(row: dict) -> str:
    """A round in a few words."""
    parts = [
        f"contact steps {100 * row['contact_steps']:.3g}%",
        f"avoidable {100 * row['avoidable']:.3g}% of decisions",
    ]
    if "descent" in row:
        parts.append(f"learning {100 * row['descent']:.0f}%")
    if "polish" in row:
        parts.append(f"polishing, {row['violated']} rows left")
    return "  ".join(parts)


def keep(folder: Path, model: Model, how: LoopConfig, found: Repaired, fresh: dict | None = None) -> Model:
    """Saves the repaired model in FOLDER/checkpoints and FOLDER/repair.json; returns it as it was saved.

    `fresh`: contacts in scenes that no round had.
    """
    about = {name: value for name, value in model.about.items() if name != "step"}
    about["repair"] = {
        "settings": plain(how), "scene_seed": SCENES + how.seed, "status": found.status.value,
        "of": fingerprint(model.params),
    }  # fmt: skip
    checkpoints = Checkpoints(folder / "checkpoints")
    # Of gradient steps of imitation there are as many as before; a newer save of the same repair counts on.
    step = max(checkpoints.latest() or 0, model.about.get("step", 1) - 1) + 1
    checkpoints.save(step, {"params": jax.tree.map(np.asarray, found.params)}, about)
    checkpoints.close()
    document = {
        "status": found.status.value,
        "best_round": found.best,
        "verification": found.verification.plain(),
        "settings": plain(how),
        "rounds": found.history,
        "fresh": fresh,
        "gap": found.gap,
        "seconds": round(found.seconds, 1),
        "commit": commit(),
        "hardware": hardware(),
    }
    write_whole(folder / "repair.json", json.dumps(document, indent=1) + "\n")
    return Model(model.config, model.scales, model.integrator, found.params, about | {"step": step})


def words(found: Repaired, how: LoopConfig, fresh: dict) -> str:
    """What was done and what holds, in plain words. `fresh`: contacts in scenes that no round had, and how many of
    them were lost at the start."""
    once = how.method in ("thesis", "last-layer")
    what = f"can keep the {how.constraint.name}" if once else f"broke the {how.constraint.name} without need"
    v, before = found.verification, found.history[0]["contact_steps"]
    touched = round(fresh["trajectories"] * fresh["scenes"])
    _, most = clopper_pearson(touched, fresh["scenes"])
    lines = [
        f"status: {found.status.value}, after {found.seconds:.0f} s; weights of round {found.best}",
        f"  {v.rows} training decisions that {what}: "
        f"{v.avoidable} break it as executed, {v.violated_before_clip} before the limits clip them",
        f"  in {fresh['scenes']} scenes that no round had: contact steps {100 * fresh['contact_steps']:.3g}% (before, "
        f"in others: {100 * before:.3g}%); {touched} scenes with a contact"
        + (f" ({fresh['lost']} of them lost at the start, whatever anybody does)" if fresh["lost"] else "")
        + f", so with 95% confidence at most {100 * most:.2g}% of such scenes have one",
        "  this is evidence about scenes like these, no proof for others: `swarmnet certify` proves a region",
    ]
    return "\n".join(lines)


def _claim(folder: Path, how: LoopConfig, model: Model, asked: dict) -> None:
    """Says in FOLDER/settings.json what is repaired and how; refuses a folder of another repair."""
    mine = {"settings": plain(how), "of": fingerprint(model.params), **asked}
    path = folder / "settings.json"
    if path.exists():
        try:
            known = json.loads(path.read_text())
        except ValueError as error:
            raise SwarmError(f"{path}: is damaged; remove {folder} or name another --run") from error
        if known != json.loads(json.dumps(mine)):
            raise SwarmError(f"{folder}: holds another repair; name another --run, or remove it")
        return
    if (folder / "checkpoints").exists():
        raise SwarmError(f"{folder}: holds a model that no repair made; name another --run")
    write_whole(path, json.dumps(mine, indent=1) + "\n")


def _release(folder: Path) -> None:
    """Takes a claim back where nothing has come of it."""
    if [path.name for path in folder.iterdir()] == ["settings.json"]:
        (folder / "settings.json").unlink()
        folder.rmdir()


def _done(folder: Path) -> bool:
    """Whether a repair came to its end here; a damaged repair.json is written anew."""
    try:
        known = json.loads((folder / "repair.json").read_text())
    except (OSError, ValueError):
        return False
    return isinstance(known, dict) and {"status", "rounds"} <= set(known) and (folder / "checkpoints").is_dir()
