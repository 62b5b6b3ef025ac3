"""From files to trajectories: read, put on a grid, hold out, cut into scenes, write; and the data set's card."""

import contextlib
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from envs.importers import card
from envs.importers.config import ImportConfig
from envs.importers.holdout import held_out
from envs.importers.registry import check_options, read
from envs.importers.samples import from_first_agent, sampled, time_step
from envs.importers.scenes import assembled, cut, rows_per_scene
from envs.importers.survey import Survey, survey
from envs.importers.tracks import ImportFailed, Update, readable
from envs.plain import plain
from envs.storage import Header, TrajectoryWriter, read_header
from envs.trajectories import TrajectoryError, versions
from swarm_mjcf.whole import WholeFile

VERSION = 2
"""Counted up when the same files and options give other trajectories, so that a file made before is not taken for one
made now. 2: runs begin with the first row that an agent is in."""
BLUR = 0.1
"""Single precision must tell positions apart by this share of a median step at least."""


@dataclass(frozen=True)
class Imported:
    """What was written."""

    header: Header
    holdout: Header | None
    existed: bool
    """Whether the files held exactly this already."""

    @property
    def card(self) -> dict:
        """The data set's card, plain JSON."""
        return self.header.provenance["import"]


def holdout_path(out: Path) -> Path:
    """NAME_holdout.h5 beside NAME.h5."""
    return out.with_name(f"{out.stem}_holdout{out.suffix}")


def card_path(out: Path) -> Path:
    """NAME.card.md beside NAME.h5."""
    return out.with_suffix(".card.md")


def import_files(
    files: Sequence[Path], config: ImportConfig, out: Path, *, command: str = "", update: Update = lambda *_: None
) -> Imported:
    """Writes `out`, its card, and its hold-out beside it where one is asked for; each whole or not at all.

    Files that hold exactly this already are kept; a card that was deleted is written again, with lists as long as the
    file's own copy has them.

    Args:
      files: recordings; each is one run, or several where it says so.
      command: what was typed, for the card.
      update: told how far the work is.

    Raises:
      ImportFailed: a file cannot be used; SpecError: an option does not fit; TrajectoryError: `out` holds something
      else, or cannot be written.
    """
    if not files:
        raise ImportFailed("no files to import")
    sources = [_source(path) for path in files]
    check_options(files, config)
    outs = [out, *([holdout_path(out)] if config.holdout else [])]
    marks = [fingerprint(sources, config, version) for version in range(1, VERSION + 1)]
    mark = marks[-1]
    have = [_existing(path, marks) for path in outs]
    if all(have):
        for path, header in zip(outs, have, strict=True):
            if header is not None and not card_path(path).exists():
                _write_text(card_path(path), card.render(header.provenance["import"], path.name))
        return Imported(have[0], have[1] if config.holdout else None, existed=True)  # pyright: ignore[reportArgumentType]
    tracks, facts = [], []
    for path in files:
        found = read(path, config, update)
        tracks += found
        facts.append(found[0].facts)
    dt = time_step(tracks, config)
    everything = []
    for number, track in enumerate(tracks):
        everything.append(from_first_agent(sampled(track, dt, config), dt))
        update(number + 1, len(tracks), "resample")
    runs = [run for run in everything if run.agents.any()]
    if not runs:
        raise ImportFailed(f"{tracks[0].name}: no agent has two rows {dt:g} s apart, so there is no velocity")
    figures = survey(runs, dt, config)
    _check_precision(figures, dt)
    train, held, divided = held_out(runs, config)
    parts = {"training part": train, "held-out part": held} if held else {"everything": train}
    about = card.card(
        sources=[source | {"facts": fact} for source, fact in zip(sources, facts, strict=True)],
        config=config,
        dt=dt,
        read=everything,
        runs=runs,
        figures=figures,
        divided=divided,
        command=command,
    )
    cards = []
    with contextlib.ExitStack() as stack:
        writers = [stack.enter_context(TrajectoryWriter(path)) for path in outs]
        for writer, (part, of_part) in zip(writers, parts.items(), strict=True):
            rows = rows_per_scene(of_part, dt, config)
            scenes = cut(of_part, rows)
            cards.append(about | card.part(part, of_part, scenes, rows))
            provenance = {"fingerprint": mark, "import": card.brief(cards[-1]), "versions": versions()}
            done = 0
            for slab in assembled(scenes, rows=rows, dt=dt, config=config, provenance=provenance):
                writer.append(slab)
                update(done := done + len(slab), len(scenes), f"write {writer.path.name}")
    for path, of_part in zip(outs, cards, strict=True):
        _write_text(card_path(path), card.render(of_part, path.name))
    headers = [read_header(path) for path in outs]
    return Imported(headers[0], headers[1] if config.holdout else None, existed=False)


def fingerprint(sources: Sequence[dict], config: ImportConfig, version: int = VERSION) -> str:
    """What the result depends on, as a short hash: the files' bytes, the options, and how they are understood."""
    about = {"sources": [source["sha256"] for source in sources], "import": plain(config)}
    if version > 1:  # as the first one was written
        about["version"] = version
    return hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:16]


def _source(path: Path) -> dict:
    """Name, size and checksum of a file, and of those that belong to it."""
    size, digest = readable(path), hashlib.sha256()
    beside = path.name.removesuffix("_timeseries.npy")
    others = [path.with_name(f"{beside}_{what}.npy") for what in ("edge", "time")] if beside != path.name else []
    for part in (path, *(other for other in others if other.exists())):
        with part.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return {"name": path.name, "bytes": size, "sha256": digest.hexdigest()}


def _existing(path: Path, marks: Sequence[str]) -> Header | None:
    """The header of a file that holds what the last of `marks` stands for; earlier ones are of older versions."""
    if not path.exists():
        return None
    header = read_header(path)
    made = header.provenance.get("fingerprint")
    if made in marks[:-1]:
        raise TrajectoryError(
            f"{path}: was imported from the same files by an older version, which made other rows of them; delete "
            "it, or choose another name"
        )
    if made != marks[-1]:
        raise TrajectoryError(f"{path}: exists and holds something else; choose another name or delete it first")
    return header


def _check_precision(figures: Survey, dt: float) -> None:
    step = figures.speed[1] * dt
    blur = float(np.spacing(np.float32(figures.largest)))
    if step and blur > BLUR * step:
        raise ImportFailed(
            f"coordinates reach {figures.largest:.6g} m, where single precision tells {blur:.2g} m apart, too coarse "
            f"for a median step of {step:.2g} m; subtract a point near the data with --origin X Y"
        )


def _write_text(path: Path, text: str) -> None:
    try:
        with WholeFile(path) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise TrajectoryError(f"{path}: cannot be written ({error.strerror})") from error
