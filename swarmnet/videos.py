"""Videos of recorded scenes: one, many in a grid, or several recordings of one scene side by side.

`python -m swarmnet.videos RUN FOLDER` writes the pictures of the README from a run.
"""

import json
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from PIL import Image

from envs.trajectories import Trajectories
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.video import write_video
from swarm_mjcf.whole import WholeFile
from swarmnet.figures import STYLE, load_pair, paths_over_paths, telling_scenes
from swarmnet.film import Film, Look, Panel, film, timing
from swarmnet.selection import select

Progress = Callable[[int, int, str], None]
"""Called with (videos or pictures done, how many in all, a few words)."""
_OURS = re.compile(r"scene-(\d+)-(top|tilted)")
"""Names that `make_videos` gives."""


@dataclass(frozen=True)
class VideoFile:
    """A video on disk with the words that belong to it."""

    path: Path
    title: str
    poster: Path | None
    """A still of it, jpeg."""


def make_video(
    files: Sequence[str | Path],
    out: str | Path,
    *,
    scenes: Sequence[int] = (0,),
    grid: str | None = None,
    titles: Sequence[str] = (),
    look: Look | None = None,
    progress: Progress | None = None,
) -> Path:
    """Writes a video of what `swarmnet.selection.select` selects; returns the path really written (a gif without
    ffmpeg). Several files are shown with one view, scenes of one file each with its own.

    Raises:
      SwarmError: a value is out of range, or the files cannot be shown together.
    """
    chosen = select(files, scenes=scenes, grid=grid, titles=titles)
    shown = film(chosen.panels, look or Look(), columns=chosen.columns, one_view=chosen.compared)
    return write_video(out, _counted(shown, progress), shown.fps)


def compared(one: Trajectories, other: Trajectories, names: tuple[str, str], title: str, look: Look) -> Film:
    """Two recordings of one scene side by side, the first dashed in the second."""
    words = [" · ".join(filter(None, (name, title))) for name in names]
    panels = [Panel(one, words[0]), Panel(other, words[1], one, names[0])]
    return film(panels, look, columns=2, one_view=True)


def _counted(shown: Film, progress: Progress | None) -> Iterator[np.ndarray]:
    try:
        for number, picture in enumerate(shown.pictures):
            if progress:
                progress(number + 1, shown.count, "")
            yield picture
    finally:
        shown.pictures.close()  # type: ignore[attr-defined]  # a generator, which frees its renderers


def make_videos(run: str | Path, count: int, *, progress: Progress | None = None, size: int = 480) -> list[VideoFile]:
    """Writes RUN/videos: reference | model for the `count` most telling scenes from above, the first also tilted.

    Scenes in which the model touches something come first. Files newer than the rollouts are kept.
    """
    run = Path(run)
    pair = load_pair(run, "expert", "learned")
    if pair is None or count < 1:
        return find_videos(run)
    (expert, learned), beside = pair, reference_of(run)
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
        shown = compared(one, other, (beside, "model"), f"scene {scene}", Look(camera=camera, size=size))
        written = write_video(path, _with_still(shown.pictures, row * pace.between // pace.every, path), pace.fps)
        # Without ffmpeg a gif was written instead of the mp4; its still has the same name.
        path.with_suffix(".gif" if written.suffix == ".mp4" else ".mp4").unlink(missing_ok=True)
    if progress:
        progress(len(wanted), len(wanted), "")
    return find_videos(run)


def reference_of(run: Path) -> str:
    """What the reference was called when the run was judged last: the expert, or another policy."""
    path = run / "evaluation.json"
    named = json.loads(path.read_text()).get("reference") if path.exists() else None
    return named or "expert"


def find_videos(run: str | Path) -> list[VideoFile]:
    """The videos of RUN/videos that are newer than its rollouts; the tilted view follows its scene, contacts first."""
    folder = Path(run) / "videos"
    paths = [p for p in folder.glob("*") if p.suffix in (".mp4", ".gif") and not p.name.startswith(".")]
    made = sorted((p for p in paths if _fresh(Path(run), p)), key=lambda p: (p.stat().st_mtime_ns, p.name))
    found, beside = [], reference_of(Path(run))
    for path in made:
        known = _OURS.fullmatch(path.stem)
        title = path.stem
        if known:
            title = f"Scene {int(known[1])}: {beside} | model" + (", tilted view" if known[2] == "tilted" else "")
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
        shown = compared(expert, learned, ("expert", "model"), "", Look(camera="tilted", size=size, speed=speed))
        gif = write_video(folder / "demo.gif", shown.pictures, shown.fps)
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
            with WholeFile(video.with_suffix(".jpg")) as part:
                Image.fromarray(picture).save(part, format="JPEG", quality=82)
        yield picture


def _fresh(run: Path, path: Path) -> bool:
    """Whether a file exists and is at least as new as the rollouts of the run."""
    rollouts = [run / "rollouts" / name for name in ("expert.h5", "learned.h5")]
    newest = max((p.stat().st_mtime_ns for p in rollouts if p.exists()), default=0)
    return path.exists() and path.stat().st_mtime_ns >= newest


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m swarmnet.videos RUN FOLDER")
    for file in readme_media(sys.argv[1], sys.argv[2]):
        print(file)
