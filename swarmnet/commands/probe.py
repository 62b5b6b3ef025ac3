"""`swarmnet probe`."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from envs.config import SimulateConfig
from envs.experts.config import ExpertConfig
from envs.plain import from_plain
from envs.simulate import simulate_in_memory
from envs.storage import load
from envs.trajectories import AGENT, Trajectories
from gnn.checkpoint import Model, load_model
from gnn.contributions import along
from gnn.force_fields import SIMULATED, ForceField, Spans, force_field, spans_of
from gnn.laws import LawError
from gnn.messages import edge_kinds
from gnn.probe import linear_probe
from gnn.ranges import samples_of
from gnn.separation import HORIZONS, separation
from swarm_mjcf.errors import SpecError, SwarmError
from swarmnet.config import Probe
from swarmnet.figures import STYLE, svg
from swarmnet.figures_probe import contribution_figure, force_field_figure, separation_figure
from swarmnet.judge import training_world
from swarmnet.recorded import check_data
from swarmnet.results import write_whole

PROBED = 4
"""Scenes that the linear probe needs: it is fitted to a half and tested on the other."""
DRAWN = 3
"""Agents whose contributions are drawn."""
PICTURES = ("probe-position", "probe-velocity", "probe-contributions", "figure-5.1")
"""What may be in RUN/figures after it; one that this call cannot draw is removed, as it would show another network."""


@mpl.rc_context(STYLE)
def run(config: Probe) -> int:
    """Looks inside and prints; RUN gets probe.json and figures/probe-*.svg."""
    if config.scenes < 1:
        raise SpecError("scenes", config.scenes, "at least 1")
    model = load_model(config.run / "checkpoints")
    kinds = edge_kinds(model)
    data, expert = _data(config, model)
    if not 0 <= config.scene < len(data):
        raise SpecError("scene", config.scene, f"from 0 to {len(data) - 1}")
    found: dict[str, Any] = {"scenes": len(data), "dt": data.dt}
    pictures: dict[str, Figure | None] = dict.fromkeys(PICTURES)
    span = SIMULATED if expert is not None else _spans(data)
    fields = [_known(model, kind, expert, over, span) for kind in kinds for over in ("position", "velocity")]
    found["force_fields"] = [
        {"kind": f.kind, "over": f.over, "r2": _finite(f.r2), "relative_error": _finite(f.relative_error)}
        for f in fields
    ]
    for over in ("position", "velocity"):
        pictures[f"probe-{over}"] = force_field_figure([field for field in fields if field.over == over])
    for one in found["force_fields"]:
        if one["r2"] is not None:
            print(f"{one['kind']} over relative {one['over']}: R2 {one['r2']:.3f}, error {one['relative_error']:.1%}")
    if expert is None:
        print("no true laws, no linear probe, no figure 5.1: what law made these trajectories is not known")
    elif len(data) < PROBED:
        print(f"no linear probe: it needs {PROBED} scenes, there are {len(data)}")
    elif "agent" in kinds and data.counts[2] > 1:
        try:
            probe = linear_probe(model, data, expert, seed=config.seed)
            found["linear_probe"] = {k: getattr(probe, k) for k in ("r2", "shuffled", "fitted", "tested")}
            print(f"messages between agents -> true pair force: R2 {probe.r2:.3f} (shuffled {probe.shuffled:.3f})")
        except LawError as error:
            print(f"no linear probe: {error}")
    pictures["probe-contributions"] = _contributions(config, model, data)
    if expert is not None:
        try:
            columns = separation(model, data, expert, walls_stay=config.walls_stay)
            found["figure-5.1"] = {
                name: dict(zip(map(str, column.error.horizons), column.error.published_mean, strict=True))
                for name, column in columns.items()
            }
            for name, column in columns.items():
                error = dict(zip(column.error.horizons, column.error.published_mean, strict=True))
                said = ", ".join(f"{error[h]:.3g} at {h}" for h in HORIZONS if h in error)
                print(f"figure 5.1 ({name}) {' + '.join(column.kinds)}: normalized error {said} steps")
            pictures["figure-5.1"] = separation_figure(columns, tuple(range(min(2, len(data)))))
        except LawError as error:
            print(f"no figure 5.1: {error}")
    for name, picture in pictures.items():
        path = config.run / "figures" / f"{name}.svg"
        if picture is None:
            path.unlink(missing_ok=True)
        else:
            write_whole(path, svg(picture))
    write_whole(config.run / "probe.json", json.dumps(found, indent=1) + "\n")
    print(f"{config.run}: probe.json, figures/probe-*.svg")
    return 0


def _data(config: Probe, model: Model) -> tuple[Trajectories, ExpertConfig | None]:
    """Scenes that the model has not seen, or the recording that it learned from or one that is named, and the law that
    made them where it is known."""
    path = config.data or _recording(model)
    if path is None:
        seen = training_world(model)
        if config.seed == seen.seed:
            raise SpecError("seed", config.seed, f"another seed than the training data's, {seen.seed}")
        world = replace(seen, scenes=config.scenes, seed=config.seed)
        return simulate_in_memory(world), world.world().expert
    data = load(path).take(slice(0, config.scenes))
    if config.data is None:
        print(f"scenes of {path}, which the model learned from (--data names others)")
    trained = model.integrator
    if abs(trained.dt - data.dt) > 1e-6 or trained.substeps != data.substeps:
        raise SwarmError(
            f"{path}: has rows {data.dt:g} s apart with {data.substeps} substeps, the model was trained at "
            f"dt {trained.dt:g} s with {trained.substeps}"
        )
    check_data(model, data, path)
    settings = data.provenance.get("simulate")
    return data, None if settings is None else from_plain(SimulateConfig, settings).world().expert


def _spans(data: Trajectories) -> Spans:
    samples = samples_of(data)
    if not np.any(samples["speed"] > 0):
        raise SwarmError(f"nobody moves in the {len(data)} scenes: no law of motion is seen in them")
    return spans_of(samples)


def _recording(model: Model) -> Path | None:
    """The imported file that a model learned from, where it says so and the file is still there."""
    named = [Path(about["learn"]["data"]) for about in model.trained_on if "learn" in about and "simulate" not in about]
    return next((path for path in named if path.exists()), None)


def _contributions(config: Probe, model: Model, data: Trajectories) -> Figure | None:
    """Of the first agents that are in the scene at any time, with gaps where they are not."""
    scene, window = config.scene, model.config.window
    mask = data.mask[scene][:, data.kind[scene] == AGENT]
    there = np.lib.stride_tricks.sliding_window_view(mask, window, axis=0).all(axis=-1)  # in all that the model sees
    agents = tuple(int(agent) for agent in np.flatnonzero(there.any(axis=0)))
    if not agents:
        print(f"no contributions: no agent of scene {scene} is there for as many rows as the model sees, {window}")
        return None
    parts = {kind: np.where(there[..., None], part, np.nan) for kind, part in along(model, data, scene).items()}
    if len(agents) > DRAWN:
        print(f"contributions: drawn for the first {DRAWN} of the {len(agents)} agents of scene {scene}")
    return contribution_figure(parts, dt=data.dt, agents=agents[:DRAWN], first_row=window - 1)


def _known(model: Model, kind: str, expert: ExpertConfig | None, over: str, span: Spans) -> ForceField:
    """The field beside the true law, or alone where the expert has no law for this type."""
    reach = span.velocity if over == "velocity" else span.agents if kind == "agent" else span.others
    at: dict[str, Any] = {
        "over": over,
        "reach": reach,
        "velocity": (0.0, span.speed),
        "goal": span.goal if kind != "goal" and "goal" in edge_kinds(model) else None,
        "apart": (0.0, span.apart) if kind == "agent" else span.beside,
    }
    try:
        return force_field(model, kind, expert, **at)
    except LawError:
        return force_field(model, kind, None, **at)


def _finite(value: float) -> float | None:
    return None if value != value else value
