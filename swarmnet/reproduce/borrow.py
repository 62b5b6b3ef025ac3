"""A network that a cell of another experiment has trained in just the same way is not trained twice."""

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from envs.plain import plain
from envs.trajectories import Trajectories
from gnn.checkpoint import CheckpointError, Model, load_model
from gnn.train import fingerprint
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Effort
from swarmnet.reproduce.work import curriculum, trained

RUN = ("checkpoints", "metrics.jsonl", "plan.json")
"""What a run consists of; the plan comes last, where it is there the run is whole."""


@dataclass(frozen=True, kw_only=True)
class Learning:
    """One training of a cell, for the minutes of its effort."""

    model: str
    """Preset."""
    seed: int
    part: str = "."
    """Its folder in that of the cell, where a cell trains more than once."""
    initial: Model | None = None
    """What is tuned."""
    freeze: tuple[str, ...] = ()


def trained_once(wanted: Learning, data: Trajectories, effort: Effort, place: Path, progress: Update) -> Model:
    """`work.trained` in the cell's folder `place`, or a copy of what a cell of any experiment beside has.

    Copied is what had the same preset, seed, data, minutes, initial weights and frozen parts, and came to its end.
    """
    folder = place / wanted.part
    if not (folder / RUN[-1]).exists():
        for plan in sorted(place.parents[3].glob(f"*/*/*/seed-{wanted.seed}/**/{RUN[-1]}")):
            if _same(plan, wanted, data, effort):
                for name in RUN:
                    _copy(plan.parent / name, folder / name)
                break
    return trained(
        wanted.model, data, effort, folder, progress, seed=wanted.seed, initial=wanted.initial, freeze=wanted.freeze
    )


def _same(path: Path, wanted: Learning, data: Trajectories, effort: Effort) -> bool:
    """Whether the run with this plan is finished, and the one that is wanted."""
    plan = json.loads(path.read_text())
    given = plain(curriculum(wanted.model, wanted.seed, effort.minutes)) | {"checkpoint_seconds": None}
    if (plan["minutes"], plan["given"]) != (effort.minutes, given):
        return False
    try:
        about = load_model(path.parent / "checkpoints").about
    except CheckpointError:
        return False
    began = None if wanted.initial is None else fingerprint(wanted.initial.params)
    return (
        about["train"] == given | {"stage_steps": plan["stage_steps"]}
        and about["step"] == sum(plan["stage_steps"])
        and _origin(about["data"]) == _origin(data.provenance)
        and (about.get("initial") or {}).get("weights") == began
        and tuple(about.get("freeze") or ()) == wanted.freeze
    )


def _origin(provenance: dict) -> str:
    """Where data come from, as text; without the number of scenes that a run kept after its validation scenes."""
    return json.dumps({key: value for key, value in provenance.items() if key != "scenes"}, sort_keys=True)


def _copy(source: Path, target: Path) -> None:
    """Copies a file or folder, whole or not at all."""
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = target.with_name(f".{target.name}.partial")
    for old in (partial, target):
        if old.is_dir():
            shutil.rmtree(old)
        old.unlink(missing_ok=True)
    if source.is_dir():
        shutil.copytree(source, partial)
    else:
        shutil.copy2(source, partial)
    os.replace(partial, target)
