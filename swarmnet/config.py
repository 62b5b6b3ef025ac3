"""The command line: one frozen dataclass per command, its docstring is its help. Standard library only.

Here are the commands around data and pictures; those that learn are in `swarmnet.config_learning`, those that
make safe in `swarmnet.config_repair`.
"""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from envs.config import SimulateConfig
from envs.importers.config import ImportConfig
from envs.shards import Shard
from swarm_mjcf.errors import SpecError
from swarmnet.config_learning import RL, Evaluate, Learn, Probe, Reproduce, Schedule, Train
from swarmnet.config_repair import Certify, Repair


@dataclass(frozen=True, kw_only=True)
class Simulate(SimulateConfig):
    """Simulate scenes with an expert in MuJoCo and record them.

    Writes one HDF5 file (positions, velocities, masks, contacts, provenance), whole or not at all. Chunks that are done
    are kept beside it until then: an interrupted call goes on where it was. Machines can share the work: with --shard
    each writes its part, and `swarmnet merge` makes of them the file that one call would have written.

    Example:
      swarmnet simulate --preset clear --scenes 2000 --seed 0 --out runs/clear.h5
      swarmnet simulate --start corridor --num-obstacles 6 --rules separation obstacle goal --out runs/corridor.h5
      swarmnet simulate --scenes 100000 --shard 2/4 --out runs/big.h5
      swarmnet simulate --num-agents 10 --export-xml scene.xml
    """

    out: Path = Path("runs/trajectories.h5")
    """File to write; shard 2 of 4 of NAME.h5 goes to NAME.shard-2-of-4.h5."""
    shard: str = "1/1"
    """i/n: compute only the i-th of n parts (1 <= i <= n)."""
    export_xml: Path | None = None
    """Write the world's MJCF here, for MuJoCo's own tools, and simulate nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        Shard.parse(self.shard)


@dataclass(frozen=True, kw_only=True)
class Merge:
    """Join the shards of one simulation, in any order, into the file that one call would have written, to the byte.

    Every part is checked against its checksums. Parts of other settings or versions, parts given twice and missing ones
    are refused by name.

    Example:
      swarmnet merge runs/big.shard-*.h5 --out runs/big.h5
    """

    parts: tuple[Path, ...]
    """Files written by `swarmnet simulate --shard`."""
    out: Path = Path("runs/trajectories.h5")
    """File to write."""


@dataclass(frozen=True, kw_only=True)
class Import(ImportConfig):
    """Import recorded trajectories: CSV, Parquet, the published arrays, Juelich text, JuPedSim, ETH, TrajNet++, MATLAB.

    Units and frame rates are declared or read from a header, never guessed; median speed and spacing are printed, so
    that a wrong one is seen. One long recording becomes scenes of --segment seconds. Beside the file lies a card with
    source, licence, counts, gaps and outliers. `docs/data.md` has a command for every format.

    Example:
      swarmnet import bottleneck.txt --dt 0.16 --holdout 0.2 --licence CC-BY-4.0 --out runs/bottleneck.h5
      swarmnet import a.csv b.csv --unit m --time-unit s --columns t=time id=ped --out runs/walks.h5
    """

    files: tuple[Path, ...]
    """Recordings; of the published arrays, the NAME_timeseries.npy."""
    out: Path = Path("runs/imported.h5")
    """File to write."""


@dataclass(frozen=True, kw_only=True)
class Export:
    """Write trajectories in another format: CSV, Parquet, the published arrays, NRI's arrays, GNS's npz and metadata.

    The last three have no masks: scenes in which nodes come and go are refused, or such nodes dropped.

    Example:
      swarmnet export runs/clear.h5 --format parquet --out clear.parquet
      swarmnet export runs/clear.h5 --format published --out data/train
    """

    data: Path
    """Trajectories to export."""
    format: Literal["csv", "parquet", "published", "nri", "gns"] = "parquet"
    """Format to write."""
    out: Path | None = None
    """csv, parquet: the file. published: the beginning of the names, as in OUT_timeseries.npy. nri, gns: a folder. By
    default the data's name in the folder you are in."""
    partial: Literal["refuse", "drop"] = "refuse"
    """published, nri, gns: what to do with nodes that are there for part of a scene."""
    split: Literal["train", "valid", "test"] = "train"
    """nri, gns: which of the parts this is, for the names of the files."""
    suffix: str = ""
    """nri: end of the names, as in loc_train_springs5.npy."""
    connectivity_radius: float | None = None
    """gns: who sees whom [m]; by default everybody sees everybody, as in our graphs."""


SHEETS, VIDEOS = (".pdf", ".png", ".svg"), (".mp4", ".gif")
"""Endings of what `swarmnet render` writes."""


@dataclass(frozen=True, kw_only=True)
class Render:
    """Make a video, or a still sheet for a paper, of recorded scenes.

    One file: one scene, or many in a grid. Two to four files are compared: the same scene as each recorded it, the
    first dashed in the others. The ending of --out says what is written: .mp4 and .gif are videos, .pdf, .png and .svg
    are sheets of trajectories with axes in metres. Needs no display: without EGL a matplotlib renderer draws, and the
    message names the package to install.

    Example:
      swarmnet render runs/demo/rollouts/expert.h5 runs/demo/rollouts/learned.h5 --scene 3
      swarmnet render runs/clear.h5 --grid 3x3 --camera follow --speed 1 --out grid.mp4
      swarmnet render runs/clear.h5 --scene 0 7 12 --width page --color time --out figure.pdf
    """

    data: tuple[Path, ...]
    """Trajectories to show: 1 file, or 2 to 4 of the same scenes."""
    scene: tuple[int, ...] = (0,)
    """Scenes to show; with --grid, the first of them."""
    grid: str | None = None
    """Panels as ROWSxCOLUMNS; a grid of one file is filled with scenes from --scene on."""
    titles: tuple[str, ...] = ()
    """Names above the panels, one per file; what the files say of themselves by default."""
    contacts: bool = True
    """Show contacts: red agents, crosses that stay, counts and depth."""
    camera: Literal["top", "tilted", "follow"] = "top"
    """Videos: from above, tilted, or from above and staying with the swarm."""
    speed: float = 2.0
    """Videos: seconds of simulation per second of video; 1 is real time."""
    size: int | None = None
    """Videos: height and width of a panel [pixels]; 480 by default, less in a wide grid."""
    renderer: Literal["auto", "mujoco", "matplotlib"] = "auto"
    """Videos: MuJoCo (OpenGL) or matplotlib; auto takes MuJoCo where it works."""
    width: Literal["column", "page"] = "column"
    """Sheets: 3.4 or 7 inches wide."""
    color: Literal["agent", "time"] = "agent"
    """Sheets: what the colours of the trajectories tell."""
    out: Path = Path("video.mp4")
    """File to write: .mp4, .gif, .pdf, .png or .svg."""

    def __post_init__(self) -> None:
        if not 1 <= len(self.data) <= 4:
            raise SpecError("data", f"{len(self.data)} files", "1 to 4 files of trajectories to show")
        ending = self.out.suffix.lower()
        if ending not in VIDEOS + SHEETS:
            raise SpecError("out", str(self.out), f"a name that ends in {', '.join(VIDEOS + SHEETS)}")
        foreign = ("camera", "speed", "size", "renderer") if ending in SHEETS else ("width", "color")
        kind = f"a sheet ({ending})" if ending in SHEETS else f"a video ({ending})"
        for field in fields(self):
            if field.name in foreign and getattr(self, field.name) != field.default:
                raise SpecError(field.name, getattr(self, field.name), f"nothing: it means nothing for {kind}")


@dataclass(frozen=True, kw_only=True)
class Demo:
    """The main job, end to end: simulate Boids in MuJoCo, train a SwarmNet on it, judge it on unseen scenes, show it.

    Takes under 10 minutes on 2 cores. What is done is kept: a second call only does what is missing. The run folder
    holds data, checkpoints, metrics, figures, videos and report.html.

    Example:
      swarmnet demo --name first --scenes 2000
    """

    name: str = "demo"
    """Run folder: runs/NAME."""
    scenes: int = 2000
    """Scenes to learn from."""
    test_scenes: int = 200
    """Unseen scenes to judge by."""
    model: str = "best"
    """Preset of the model: thesis-ch5 or best."""
    scale: float = 0.5
    """Factor on the training's number of gradient steps; 1 is the full curriculum."""
    seed: int = 0
    """Seed of data and weights."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx, mjx-warp."""
    videos: int = 3
    """Scenes to make videos of."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """Write RUN/report.html anew from what the run folder holds: figures and videos embedded, no network needed.

    Example:
      swarmnet report runs/demo
    """

    run: Path
    """Run folder."""


@dataclass(frozen=True, kw_only=True)
class Doctor:
    """Print versions, devices, GL renderer and threads, and what is wrong with a fix for each.

    With --engines, every engine here is checked against sphere geometry and against the others on random dense scenes
    with walls, and the numbers of wrong and borderline contact flags and counts are printed.

    Example:
      swarmnet doctor --engines
    """

    engines: bool = False
    """Check the physics engines (under 3 minutes on 2 cores)."""
    scenes: int = 100_000
    """Random scenes for --engines."""
    json: Path | None = None
    """Also write the results here, machine-readable."""

    def __post_init__(self) -> None:
        if self.scenes < 1:
            raise SpecError("scenes", self.scenes, "at least 1")


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure: `engines` (scene-steps/s, as ratios to bare mujoco.batch), `experts` (cost per agent up to 1000 agents),
    `adapters` (Gymnasium, PettingZoo, dm_env, as ratios to the environment itself), `throughput` (10 agents and 5
    obstacles with random actions and resets, batches up to 32k on a GPU), `imitation` (simulate, train, prediction
    error), `train` (windows/s, the share of time in the compiled step, one core against Keras where it is installed),
    `rl` (env-steps/s of physics, rollout, update and whole PPO, beside the arithmetic's own time), `repair` (seconds
    until a gap of 1% is proven against rows and box, with a figure beside the JSON), `rendering` (frame rates), `build`
    (scenes per second).

    Example:
      swarmnet bench engines --json docs/results/bench-engines.json
    """

    what: Literal[
        "engines", "experts", "adapters", "throughput", "imitation", "train", "rl", "repair", "rendering", "build"
    ]
    """What to measure."""
    agents: tuple[int, ...] = (5, 10, 20, 100, 1000)
    """engines, experts: numbers of agents, each with 1 obstacle."""
    substeps: tuple[int, ...] = (1, 15)
    """engines, throughput: physics steps per control step."""
    repeats: int = 3
    """engines, experts, adapters: interleaved repetitions; medians are printed."""
    engine: tuple[str, ...] = ("native", "mjx")
    """throughput: engines to measure."""
    batch: tuple[int, ...] = ()
    """throughput, rl: scenes per batch; by default 64 and 512 (rl: 64, 256, 1024) on a CPU, 1024 to 32768 on a GPU."""
    scenes: int = 2000
    """imitation, train, repair: training scenes."""
    scale: float = 0.8
    """imitation, train: factor on the number of gradient steps."""
    seed: int = 0
    """imitation, train, repair: seed of data and weights."""
    run: Path | None = None
    """repair: run folder of the network; by default one of preset thesis-ch5-small is trained, in minutes."""
    seconds: float = 120.0
    """repair: limit for a proof of edge functions; a quarter of it for those of the last layer, a tenth for each
    program of the rotation over layers [s]."""
    json: Path | None = None
    """Also write the results here, machine-readable."""

    def __post_init__(self) -> None:
        for field in ("repeats", "scenes", "agents", "substeps", "batch"):
            value = getattr(self, field)
            if any(number < 1 for number in (value if isinstance(value, tuple) else (value,))):
                raise SpecError(field, value, "at least 1")
        if not self.seconds > 0:
            raise SpecError("seconds", self.seconds, "above 0 [s]")


Command = (
    Simulate
    | Merge
    | Train
    | Schedule
    | RL
    | Repair
    | Certify
    | Evaluate
    | Learn
    | Probe
    | Render
    | Demo
    | Report
    | Doctor
    | Bench
    | Import
    | Export
    | Reproduce
)


def part_of[T](kind: type[T], config: object) -> T:
    """The fields of `config` that `kind` has, as a `kind`: a command without what only the command line needs."""
    own: Any = kind
    return kind(**{f.name: getattr(config, f.name) for f in fields(own)})
