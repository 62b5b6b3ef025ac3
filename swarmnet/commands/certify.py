"""`swarmnet certify`."""

import io
import json
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import numpy as np

from envs.plain import plain
from gnn.checkpoint import load_model
from repair.certify import Certificate, Effort, certify
from repair.constraints.barrier import Barrier
from repair.network import Situations, check_encodable
from repair.ring import Box, Region, Ring
from swarm_mjcf.errors import SwarmError
from swarmnet.config_repair import Certify
from swarmnet.judge import training_world
from swarmnet.progress import progress
from swarmnet.results import commit, hardware, write_whole


def run(config: Certify) -> int:
    """Certifies and prints; RUN gets certificate.json and counter-examples.npz. 1 where there is a counter-example."""
    model = load_model(config.run / "checkpoints")
    check = check_encodable(model)
    scene = training_world(model).world().scene
    goal = Box.around(config.goal, (config.goal_half,) * 2) if "goal" in model.params["edge"] else None
    neighbour = None
    if config.neighbour is not None:
        place, motion = config.neighbour_half
        neighbour = Box.around(config.neighbour, (place, place, motion, motion))
    region = Region(obstacle=config.obstacle, depth=config.distance, goal=goal, neighbour=neighbour)
    barrier = Barrier(kinematics=model.integrator, margin=config.margin, share=config.share)
    ring = Ring(region=region, barrier=barrier, bodies=scene)
    effort = Effort(seconds=config.time_limit, cells=config.cells, finest=config.finest, examples=config.examples)
    with progress("certify") as update:
        certificate = certify(model.params, model.scales, ring, normalise=check.normalise, effort=effort, update=update)
    document = {
        "region": plain(region),
        "barrier": {"margin": config.margin, "share": config.share, "reach": ring.reach},
        "kinematics": plain(model.integrator),
        "step": model.about.get("step"),
        "effort": plain(effort),
        **shares(certificate),
        "seconds": round(certificate.seconds, 1),
        "cells": certificate.cells,
        "found": certificate.found,
        "counter_examples": len(certificate.slack),
        "worst": certificate.worst,
        "commit": commit(),
        "hardware": hardware(),
    }
    write_whole(config.run / "certificate.json", json.dumps(document, indent=1) + "\n")
    examples = config.run / "counter-examples.npz"
    write_whole(examples, packed(certificate.counter_examples, certificate.slack))
    print(words(certificate, ring))
    print(f"certificate: {config.run / 'certificate.json'}; counter-examples: {examples}")
    return int(certificate.found > 0)


def shares(certificate: Certificate) -> dict[str, float]:
    """What of the ring is known, by name."""
    names = ("proven", "refuted", "undecided", "unavoidable", "harmless", "contested", "kept")
    return {name: getattr(certificate, name) for name in names}


def packed(situations: Situations, slack: np.ndarray) -> bytes:
    """As .npz: `own`, `slack`, and `senders/TYPE`, `present/TYPE` of each edge type."""
    arrays: dict[str, Any] = {"own": situations.own, "slack": slack}
    for part in ("senders", "present"):
        arrays |= {f"{part}/{name}": value for name, value in getattr(situations, part).items()}
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays
    except (OSError, ValueError, TypeError, LookupError, EOFError, BadZipFile, zlib.error) as error:
        raise SwarmError(f"{path}: holds no counter-examples; `swarmnet certify` writes them") from error


def unpacked(path: Path) -> Situations:
    """What `packed` wrote to a file."""
    with _opened(path) as arrays:
        parts: dict[str, dict] = {
            part: {name.split("/")[1]: arrays[name] for name in arrays if name.startswith(f"{part}/")}
            for part in ("senders", "present")
        }
        found = Situations(own=arrays["own"], senders=parts["senders"], present=parts["present"])
        if found.own.shape[1:] != (4,) or {len(x) for x in jax.tree.leaves(found)} != {len(found.own)}:
            raise ValueError("rows of another shape")
        return found


def words(certificate: Certificate, ring: Ring, examples: int = 2) -> str:
    """The certificate for people."""
    c, far = certificate, ring.reach + ring.region.depth
    lines = [
        f"Of all positions {ring.reach:g} to {far:g} m from the obstacle's centre and all velocities up to "
        f"{ring.barrier.kinematics.max_speed:g} m/s, by volume:",
        f"  {c.proven:8.3%} proven: the executed action keeps the barrier in every state",
        f"  {c.refuted:8.3%} refuted: it does not",
        f"  {c.undecided:8.3%} undecided",
        f"  {c.unavoidable:8.3%} unavoidable: no action within the limit keeps it",
        f"In {c.harmless:.3%} every action keeps it. Of the {c.contested:.3%} in which it is up to the policy, "
        f"{c.kept:.1%} or more are proven.",
        f"{c.cells} cells in {c.seconds:.1f} s; {c.found} counter-examples, {len(c.slack)} kept.",
    ]
    for row in range(min(examples, len(c.slack))):
        own = np.asarray(c.counter_examples.own[row])
        away = own[:2] - np.asarray(ring.region.obstacle)
        distance = float(np.hypot(*away))
        opening = float(away @ own[2:]) / distance
        lines.append(
            f"  At ({own[0]:.2f}, {own[1]:.2f}) m, {distance - ring.reach:.2f} m from touching, moving at "
            f"{np.hypot(*own[2:]):.2f} m/s ({-opening:.2f} m/s towards the obstacle), it accelerates "
            f"{-c.slack[row]:.2f} m/s^2 less outward than it has to."
        )
    return "\n".join(lines)
