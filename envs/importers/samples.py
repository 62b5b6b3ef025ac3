"""Tracks on a grid of rows dt apart: gaps, linear resampling inside a stay, and velocities that know no future."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from envs.importers.config import ImportConfig
from envs.importers.tracks import ImportFailed, Tracks
from envs.trajectories import AGENT
from swarm_mjcf.errors import SpecError

GAP = 1.5
"""Rows of one id that are further apart than this many times the recording's spacing have a gap between them."""
UNEVEN = 0.05
"""Spacings further than this share from a multiple of the usual one are uneven: then dt has to be declared."""
_SNAP = 1e-4
"""A grid time within this share of dt of a recorded row is that row."""


@dataclass(frozen=True)
class Gap:
    """Missing rows of somebody."""

    run: str
    id: str
    start: float
    """Time of the last row before it [s]."""
    length: float
    """[s]"""
    bridged: bool


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Rows of one run on its grid, by person and then by row."""

    tracks: Tracks
    row: Int[np.ndarray, " n"]
    """Row k is k dt after `start`."""
    person: Int[np.ndarray, " n"]
    """Index into `tracks.labels`."""
    position: Float[np.ndarray, "n 2"]
    """[m]"""
    velocity: Float[np.ndarray, "n 2"]
    """[m/s]"""
    start: float
    """Time of row 0 [s]."""
    gaps: tuple[Gap, ...]

    @property
    def rows(self) -> int:
        """Rows of the grid up to the last that is used."""
        return int(self.row.max(initial=-1)) + 1

    @property
    def agents(self) -> np.ndarray:
        """Which of the rows are an agent's."""
        return self.tracks.kind[self.person] == AGENT

    def take(self, which: np.ndarray, *, first: int = 0) -> "Samples":
        """Some of the rows, counted from row `first` on."""
        return replace(
            self,
            row=self.row[which] - first,
            person=self.person[which],
            position=self.position[which],
            velocity=self.velocity[which],
        )


def spacing(tracks: Tracks) -> float | None:
    """Usual time between rows of one id [s]; None where nobody has two rows."""
    steps = np.diff(tracks.time)[np.diff(tracks.id) == 0]
    if not len(steps):
        return None
    return float(f"{steps[steps <= GAP * np.median(steps)].mean():.9g}")


def time_step(runs: Sequence[Tracks], config: ImportConfig) -> float:
    """Time between rows of the result [s]: the declared one, or that of the recording.

    Raises:
      ImportFailed: it has to be declared, because rows are uneven or runs differ, or nobody has two rows.
      SpecError: the declared one is finer than the recording, whose missing rows would have to be invented.
    """
    known = [(step, run) for run in runs if (step := spacing(run)) is not None]
    if not known:
        raise ImportFailed(f"{runs[0].name}: nobody has two rows, so nothing moves")
    finest, coarsest = min(known, key=lambda k: k[0]), max(known, key=lambda k: k[0])
    if config.dt is not None:
        if config.dt < coarsest[0] * (1 - 1e-3):
            raise SpecError(
                "dt",
                config.dt,
                f"at least {coarsest[0]:g} s, the spacing of {coarsest[1].name}: rows between would be invented",
            )
        return config.dt
    if coarsest[0] > finest[0] * (1 + 1e-3):
        raise ImportFailed(
            f"rows are {finest[0]:g} s apart in {finest[1].name} and {coarsest[0]:g} s in {coarsest[1].name}; give --dt"
        )
    for usual, run in known:
        steps = np.diff(run.time)[np.diff(run.id) == 0] / usual
        if (np.abs(steps - np.round(steps)) > UNEVEN * steps).any() or (steps < 0.5).any():
            raise ImportFailed(f"{run.name}: rows are unevenly spaced, about {usual:g} s and in between; give --dt")
    return coarsest[0]


def sampled(tracks: Tracks, dt: float, config: ImportConfig) -> Samples:
    """A run on a grid of rows `dt` [s] apart from its first row on.

    A stay is a time without a gap. Positions are interpolated linearly between its rows and never beyond them. With
    backward differences, `v[k] = (x[k] - x[k-1]) / dt`, the first grid row of an agent's stay has no velocity: the
    stay begins at the second. Then x' = x + v' dt holds exactly, which is the decoder's formula with one substep. Goals
    and obstacles that never move have velocity 0 from the first row on; with one row alone they stand there always.

    Raises:
      ImportFailed: a gap, with `gap` = error; or the file's velocities are asked for and it has none.
    """
    own = config.velocity == "file" or (config.velocity == "auto" and tracks.edges is not None)
    if own and tracks.velocity is None:
        raise ImportFailed(f"{tracks.name}: has no velocities (vx, vy) of its own, use --velocity difference")
    usual = spacing(tracks) or dt
    start, end = float(tracks.time.min()), float(tracks.time.max())
    first = np.flatnonzero(np.diff(tracks.id, prepend=-1))
    limit = GAP * usual if config.gap != "interpolate" else max(config.max_gap, GAP * usual)
    parts: list[tuple[np.ndarray, ...]] = []
    gaps: list[Gap] = []
    for person, (a, b) in enumerate(zip(first, [*first[1:], len(tracks.id)], strict=True)):
        time, position = tracks.time[a:b], tracks.position[a:b]
        velocity = tracks.velocity[a:b] if own and tracks.velocity is not None else None
        still = bool(tracks.kind[person] != AGENT and (position == position[0]).all())
        if still and len(time) == 1:
            time, position = np.asarray([start, end]), position.repeat(2, axis=0)
            velocity = None if velocity is None else velocity.repeat(2, axis=0)
        stays = [np.arange(len(time))]
        if not still:  # what never moves was there between its rows, too
            gaps += _gaps(tracks, person, time, GAP * usual, config)
            stays = np.split(stays[0], np.flatnonzero(np.diff(time) > limit) + 1)
        for stay in stays:
            v = None if velocity is None else velocity[stay]
            row, x, v = _stay(time[stay] - start, position[stay], v, dt, still=still)
            parts.append((row, np.full(len(row), person), x, v))
    row, person, position, velocity = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Samples(
        tracks=tracks,
        row=row,
        person=person,
        position=position - np.asarray(config.origin),
        velocity=velocity,
        start=start,
        gaps=tuple(gaps),
    )


def from_first_agent(run: Samples, dt: float) -> Samples:
    """The same run from the first row on that any agent is in; the published arrays stay whole.

    By differences nobody has a velocity in a recording's first row, and formats without masks refuse scenes that begin
    empty.
    """
    whole = run.tracks.edges is not None
    if whole or not (agents := run.agents).any() or not (first := int(run.row[agents].min())):
        return run
    return replace(run.take(run.row >= first, first=first), start=run.start + first * dt)


def _gaps(tracks: Tracks, person: int, time: np.ndarray, least: float, config: ImportConfig) -> list[Gap]:
    steps = np.diff(time)
    found = [
        Gap(
            tracks.name,
            tracks.labels[person],
            float(time[at]),
            float(steps[at]),
            config.gap == "interpolate" and bool(steps[at] <= config.max_gap),
        )
        for at in np.flatnonzero(steps > least)
    ]
    if found and config.gap == "error":
        raise ImportFailed(
            f"{tracks.name}: id {found[0].id} has no rows for {found[0].length:.3g} s after t = {found[0].start:g} s "
            f"(rows are {least / GAP:.3g} s apart); choose --gap split (it leaves and comes back), or "
            "--gap interpolate --max-gap SECONDS"
        )
    return found


def _stay(
    time: np.ndarray, position: np.ndarray, velocity: np.ndarray | None, dt: float, *, still: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid rows inside a stay, with positions and velocities there. Times count from the run's start."""
    rows = np.arange(np.ceil(time[0] / dt - _SNAP), np.floor(time[-1] / dt + _SNAP) + 1).astype(np.int64)
    grid = rows * dt
    nearest = np.searchsorted(time, grid).clip(1, max(len(time) - 1, 1)) - 1
    for candidate in (nearest, (nearest + 1).clip(max=len(time) - 1)):
        grid = np.where(np.abs(time[candidate] - grid) <= _SNAP * dt, time[candidate], grid)

    def at_grid(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(grid, time, values[:, axis]) for axis in range(2)], axis=1)

    x = at_grid(position)
    if velocity is not None:
        return rows, x, at_grid(velocity)
    if still:
        return rows, x, np.zeros_like(x)
    return rows[1:], x[1:], np.diff(x, axis=0) / dt
