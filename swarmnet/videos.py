"""Videos of recorded scenes, alone or beside another recording of the same scenes.

`python -m swarmnet.videos RUN FOLDER` writes the pictures of the README from a run.
"""

import math
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image

from envs.plain import from_plain
from envs.storage import Header, load, read_header
from envs.trajectories import AGENT, GOAL, OBSTACLE, Trajectories
from swarm_mjcf.errors import SpecError, SwarmError
from swarm_mjcf.playback import Playback
from swarm_mjcf.render import frames, side_by_side
from swarm_mjcf.spec import SceneSpec
from swarm_mjcf.video import write_video
from swarmnet.figures import STYLE, load_pair, paths_over_paths, telling_scenes

MIN_FPS, MAX_FPS = 18.0, 34.0
"""Pictures per second of video: rows are interpolated below the first and skipped above the second."""
Progress = Callable[[int, int, str], None]
"""Called with (videos done, videos in all, a few words)."""
_OURS = re.compile(r"scene-(\d+)-(top|tilted)")
"""Names that `make_videos` gives."""


@dataclass(frozen=True)
class VideoFile:
    """A video on disk with the words that belong to it."""

    path: Path
    title: str
    poster: Path | None
    """A still of it, jpeg."""


@dataclass(frozen=True)
class Timing:
    """How rows of a recording become pictures: `between` pictures per row, of which each `every`-th is drawn."""

    between: int
    every: int
    fps: float


def timing(dt: float | int, speed: float | int) -> Timing:
    """Smooth motion from control steps of `dt` seconds at `speed` seconds of simulation per second of video."""
    if not 0 < speed < math.inf:
        raise SpecError("speed", speed, "a finite number above 0")
    rate = speed / dt
    between = max(1, math.ceil(MIN_FPS / rate - 1e-9))
    every = max(1, math.ceil(rate * between / MAX_FPS - 1e-9))
    return Timing(between, every, rate * between / every)


def playback(
    trajectories: Trajectories, scene: int, title: str, *, between: int = 1, reference: Trajectories | None = None
) -> Playback:
    """One scene as it is drawn: `between` pictures per row, positions interpolated linearly.

    Contacts of a row are those of the control step that ends there, so all pictures of that step show them, and no
    other: contact steps stay as many and as long as they were. An agent is there in a step when it is at both ends.

    Args:
      reference: another recording of the same scene, drawn dashed.
    """
    t = trajectories
    goals, obstacles, agents = (np.flatnonzero(t.kind[scene] == kind) for kind in (GOAL, OBSTACLE, AGENT))
    rows = t.position.shape[1]
    # Picture p lies in the step that ends at row `end`; row 0 ends nothing and is a picture of its own.
    moment = np.arange((rows - 1) * between + 1) / between
    end = np.ceil(moment - 1e-9).astype(int)
    begin = np.maximum(end - 1, 0)
    present = t.mask[scene][:, agents]
    there = np.where((moment == end)[:, None], present[end], present[end] & present[begin])

    def at(values: np.ndarray) -> np.ndarray:
        share = (end - moment)[:, None, None]
        return share * values[begin] + (1 - share) * values[end]

    other = None
    if reference is not None:
        other = np.full((rows, len(agents), 2), np.nan)
        known = min(rows, reference.position.shape[1])
        where = reference.mask[scene, :known][:, agents]
        other[:known] = np.where(where[..., None], reference.position[scene, :known][:, agents], np.nan)
        other = at(other)
    goal = t.position[scene, 0, goals[0]] if len(goals) and t.mask[scene, 0, goals[0]] else None
    return Playback(
        position=at(t.position[scene][:, agents].astype(float)),
        agent_present=there,
        obstacle=t.position[scene, 0, obstacles],
        obstacle_present=t.mask[scene, 0, obstacles],
        goal=goal,
        touching=(t.agent_contact[scene][:, agents] > 0)[end],
        touching_solid=(t.solid_contact[scene][:, agents] > 0)[end],
        dt=t.dt / between,
        title=title,
        reference=other,
    )


def scene_spec(trajectories: Trajectories) -> SceneSpec:
    """What is drawn: the recorded world's scene, or one with the recorded radii and no border to be seen."""
    recorded = trajectories.provenance.get("world", {}).get("scene")
    if recorded:
        with suppress(KeyError):  # of another version
            return from_plain(SceneSpec, recorded)

    def largest(kind: int, default: float) -> float:
        return float(trajectories.radius.max(where=trajectories.kind == kind, initial=0)) or default

    goals, obstacles, agents = trajectories.counts
    return SceneSpec(
        num_agents=agents,
        num_obstacles=obstacles,
        agent_radius=largest(AGENT, 1.0),
        obstacle_radius=largest(OBSTACLE, 1.0),
        goal=goals > 0,
        arena=4 * max(float(np.abs(trajectories.position).max()), float(trajectories.radius.max()), 1.0),
        dt=trajectories.dt,
        substeps=1,
        contacts=False,
    )


def make_video(
    data: str | Path,
    out: str | Path,
    *,
    beside: str | Path | None = None,
    scene: int = 0,
    camera: str = "top",
    size: int = 480,
    renderer: str = "auto",
    speed: float | int = 2.0,
) -> Path:
    """Writes one scene of a file, or of two side by side; returns the path really written (a gif without ffmpeg).

    Raises:
      SwarmError: the scene does not exist, or the two files hold different scenes.
    """
    one = _scene(Path(data), scene)
    other = None
    if beside is not None:
        other = _scene(Path(beside), scene)
        if difference := _difference(one, other):
            raise SwarmError(f"{data} and {beside} do not hold the same scenes: scene {scene} has {difference}")
    names = [_name(one, Path(data)), _name(other, Path(beside)) if other and beside else ""]
    pictures = compose(one, other, f"scene {scene}", names, camera=camera, size=size, renderer=renderer, speed=speed)
    return write_video(out, pictures, timing(one.dt, speed).fps)


def compose(
    one: Trajectories,
    other: Trajectories | None,
    title: str,
    names: list[str],
    *,
    camera: str,
    size: int,
    renderer: str,
    speed: float | int,
) -> Iterator[np.ndarray]:
    """Pictures of the only scene of `one`, uint8 (H, W, 3), or beside that of `other`: each over the other, dashed."""
    pace = timing(one.dt, speed)
    options = {"camera": camera, "width": size, "height": size, "backend": renderer, "every": pace.every}

    def stream(shown: Trajectories, ghost: Trajectories | None, name: str) -> Iterator[np.ndarray]:
        what = playback(shown, 0, " · ".join(filter(None, (name, title))), between=pace.between, reference=ghost)
        return frames(scene_spec(shown), what, **options)

    left = stream(one, other, names[0])
    return left if other is None else side_by_side(left, stream(other, one, names[1]))


def make_videos(run: str | Path, count: int, *, progress: Progress | None = None, size: int = 480) -> list[VideoFile]:
    """Writes RUN/videos: expert | model for the `count` most telling scenes from above, and the first of them tilted.

    Scenes in which the model touches something come first. Files newer than the rollouts are kept.
    """
    run = Path(run)
    pair = load_pair(run, "expert", "learned")
    if pair is None or count < 1:
        return find_videos(run)
    expert, learned = pair
    wanted = [(scene, "top") for scene in telling_scenes(learned, count)]
    wanted.insert(1, (wanted[0][0], "tilted"))
    for old in (run / "videos").glob("scene-*"):
        if _OURS.fullmatch(old.stem) and not _fresh(run, old):  # of earlier rollouts
            old.unlink()
    for done, (scene, camera) in enumerate(wanted):
        if progress:
            progress(done, len(wanted), f"scene {scene}, {camera}")
        path = run / "videos" / f"scene-{scene:04d}-{camera}.mp4"
        if _fresh(run, path) or _fresh(run, path.with_suffix(".gif")):
            continue
        one, other = expert.take([scene]), learned.take([scene])
        hits = np.flatnonzero(((other.agent_contact > 0) | (other.solid_contact > 0)).any(axis=(0, 2)))
        row = max([other.position.shape[1] // 3, *hits[:1].tolist()])  # trails are long enough to see where all go
        pace = timing(one.dt, 2.0)
        pictures = compose(
            one, other, f"scene {scene}", ["expert", "model"], camera=camera, size=size, renderer="auto", speed=2.0
        )
        written = write_video(path, _with_still(pictures, row * pace.between // pace.every, path), pace.fps)
        # Without ffmpeg a gif was written instead of the mp4; its still has the same name.
        path.with_suffix(".gif" if written.suffix == ".mp4" else ".mp4").unlink(missing_ok=True)
    if progress:
        progress(len(wanted), len(wanted), "")
    return find_videos(run)


def find_videos(run: str | Path) -> list[VideoFile]:
    """The videos of RUN/videos that are newer than its rollouts; the tilted view follows its scene, contacts first."""
    folder = Path(run) / "videos"
    paths = [p for p in folder.glob("*") if p.suffix in (".mp4", ".gif") and not p.name.startswith(".")]
    made = sorted((p for p in paths if _fresh(Path(run), p)), key=lambda p: (p.stat().st_mtime_ns, p.name))
    found = []
    for path in made:
        known = _OURS.fullmatch(path.stem)
        title = path.stem
        if known:
            title = f"Scene {int(known[1])}: expert | model" + (", tilted view" if known[2] == "tilted" else "")
        still = path.with_suffix(".jpg")
        found.append(VideoFile(path, title, still if still.exists() else None))
    return found


def readme_media(run: str | Path, folder: str | Path) -> list[Path]:
    """Writes FOLDER/demo.gif (expert | model, about 6 s, at most 1.5 MB) and FOLDER/demo.png (predicted over true)."""
    run, folder = Path(run), Path(folder)
    pair, sweep = load_pair(run, "expert", "learned"), load_pair(run, "sweep_truth", "sweep_predicted")
    if pair is None or sweep is None:
        raise SwarmError(f"{run}: has no rollouts of expert, model and sweep; `swarmnet evaluate {run}` makes them")
    folder.mkdir(parents=True, exist_ok=True)
    expert, learned = (recording.take([0]) for recording in pair)
    speed = expert.dt * (expert.position.shape[1] - 1) / 6
    for size in (400, 360, 320, 280, 240, 200):
        pictures = compose(
            expert, learned, "", ["expert", "model"], camera="tilted", size=size, renderer="auto", speed=speed
        )
        gif = write_video(folder / "demo.gif", pictures, timing(expert.dt, speed).fps)
        if gif.stat().st_size <= 1_500_000:
            break
    truth, predicted = sweep
    with mpl.rc_context(STYLE):
        titles = [f"obstacle place {number}" for number in range(1, len(truth) + 1)]
        paths_over_paths(predicted, truth, titles, columns=4).savefig(folder / "demo.png", dpi=110)
    return [gif, folder / "demo.png"]


def _with_still(pictures: Iterator[np.ndarray], number: int, video: Path) -> Iterator[np.ndarray]:
    """Passes pictures on and saves one of them as NAME.jpg beside the video."""
    for index, picture in enumerate(pictures):
        if index == number:
            video.parent.mkdir(parents=True, exist_ok=True)
            partial = video.with_name(f".{video.stem}.{os.getpid()}.partial")
            Image.fromarray(picture).save(partial, format="JPEG", quality=82)
            os.replace(partial, video.with_suffix(".jpg"))
        yield picture


def _fresh(run: Path, path: Path) -> bool:
    """Whether a file exists and is at least as new as the rollouts of the run."""
    rollouts = [run / "rollouts" / name for name in ("expert.h5", "learned.h5")]
    newest = max((p.stat().st_mtime_ns for p in rollouts if p.exists()), default=0)
    return path.exists() and path.stat().st_mtime_ns >= newest


def _scene(path: Path, scene: int) -> Trajectories:
    """One scene of a file."""
    header: Header = read_header(path)
    if not 0 <= scene < header.scenes:
        only = "only scene 0" if header.scenes == 1 else f"{header.scenes} scenes, 0 to {header.scenes - 1}"
        raise SwarmError(f"{path}: there is no scene {scene}; it holds {only}")
    return load(path, scenes=scene + 1).take([scene])


def _difference(one: Trajectories, other: Trajectories) -> str | None:
    """In what two recordings of one scene differ before anything has moved, or None."""
    if one.dt != other.dt:
        return f"dt {one.dt:g} s in one and {other.dt:g} s in the other"
    if one.counts != other.counts:
        return f"{one.counts} goals, obstacles and agents in one and {other.counts} in the other"
    apart = np.abs(one.position[:, 0] - other.position[:, 0]).max()
    if (one.mask[:, 0] != other.mask[:, 0]).any() or apart > 1e-3:
        return f"other starts (up to {apart:.3g} m apart)"
    return None


def _name(trajectories: Trajectories, path: Path) -> str:
    """Who steers in a recording: what its maker wrote, or the file's name."""
    about = trajectories.provenance
    return str(about.get("policy") or about.get("expert") or path.stem)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m swarmnet.videos RUN FOLDER")
    for file in readme_media(sys.argv[1], sys.argv[2]):
        print(file)
