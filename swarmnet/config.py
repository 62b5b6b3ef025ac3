"""The command line: one frozen dataclass per command, its docstring is its help. Standard library only."""

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from envs.config import SimulateConfig
from envs.importers.config import ImportConfig
from envs.shards import Shard
from gnn.config import TrainConfig
from swarm_mjcf.errors import SpecError


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
class Train(TrainConfig):
    """Train a SwarmNet on recorded trajectories, or go on with a run that was interrupted.

    The run folder gets checkpoints/, metrics.jsonl and tensorboard/. The curriculum predicts 1, 2, 5, then 10 steps.
    Several files are mixed, smaller swarms padded with ghosts. With --init the weights of another run are tuned, with
    --freeze those that match the patterns stay as they are.

    Example:
      swarmnet train runs/clear.h5 --run runs/clear --model best --minutes 5
      swarmnet train runs/n5.h5 runs/n10.h5 --run runs/tuned --init runs/clear --freeze 'edge/*'
    """

    data: tuple[Path, ...]
    """Trajectories written by `swarmnet simulate`."""
    run: Path = Path("runs/first")
    """Run folder."""
    init: Path | None = None
    """Run folder whose trained model to start from: its weights and scales."""
    freeze: tuple[str, ...] = ()
    """Patterns over the paths of weights (edge/goal/layer0/kernel) that stay as they are; * stands for any text."""
    validation: float = 0.05
    """Share of each file's scenes kept out of training, for the validation error in the metrics."""
    scale: float = 1.0
    """Factor on the number of gradient steps of every stage."""
    minutes: float | None = None
    """Wall time of the training, compilation included: measures the speed and scales the steps of all stages to it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.data:
            raise SpecError("data", "no files", "at least 1 file of trajectories")
        if self.minutes is not None:
            if not 0 < self.minutes < math.inf:
                raise SpecError("minutes", self.minutes, "a finite number above 0")
            if self.scale != 1:
                raise SpecError("scale", self.scale, "1 with --minutes, which decides the number of steps")


@dataclass(frozen=True, kw_only=True)
class Schedule(TrainConfig):
    """Train on one swarm size and tune on others: a schedule such as 5->5-10, tested on sizes it has not seen.

    Stages are joined by ->, the sizes of a stage by -. Data is simulated for every size. The first stage trains from
    scratch, later ones tune the weights that no --freeze pattern matches on the mix of their sizes. Every stage is a
    run folder in RUN; what is done is kept. The prediction error of every stage's model on every test size is printed
    beside the thesis's table 4.3.

    Example:
      swarmnet schedule '5->5-10' --preset published --minutes 5
    """

    schedule: str
    """Stages and sizes: 5, 5->10, 5->5-10; in quotes, because > redirects the output in a shell."""
    preset: str = "published"
    """World to simulate; see `swarmnet simulate`."""
    run: Path = Path("runs/schedule")
    """Folder of data and runs."""
    scenes: int = 1000
    """Scenes to learn from, of each size."""
    steps_per_scene: int = 50
    """Control steps per scene."""
    dt: float | None = None
    """Control step [s]; the preset's own by default."""
    freeze: tuple[str, ...] = ("edge/*",)
    """Patterns over the paths of weights that stay as they are while tuning; none: tune everything."""
    validation: float = 0.05
    """Share of each size's scenes kept out of training."""
    scale: float = 1.0
    """Factor on the number of gradient steps of every stage of the curriculum."""
    minutes: float | None = None
    """Wall time of each stage of the schedule, instead of steps."""
    test_sizes: tuple[int, ...] = (3, 5, 7, 10, 20)
    """Numbers of agents to test on."""
    test_scenes: int = 100
    """Unseen scenes of each size."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx, mjx-warp."""
    json: Path | None = None
    """Also write the results here, machine-readable."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("scenes", "steps_per_scene", "test_scenes"):
            if getattr(self, field) < 1:
                raise SpecError(field, getattr(self, field), "at least 1")
        if not self.test_sizes or min(self.test_sizes) < 1:
            raise SpecError("test_sizes", self.test_sizes, "at least one size, each at least 1")
        if not 0 < self.validation < 1:
            raise SpecError("validation", self.validation, "a share between 0 and 1")
        if self.minutes is not None:
            if not 0 < self.minutes < math.inf:
                raise SpecError("minutes", self.minutes, "a finite number above 0")
            if self.scale != 1:
                raise SpecError("scale", self.scale, "1 with --minutes, which decides the number of steps")


@dataclass(frozen=True, kw_only=True)
class Learn:
    """Learn from imported trajectories and judge the prediction on those held out: train, evaluate, report.

    The recording is cut into short scenes of those present, so that graphs stay small however many come and go, and
    the model's speed and acceleration are limited to little more than the recorded ones. A run that was interrupted
    goes on.

    Example:
      swarmnet import walks.txt --dt 0.16 --segment 30 --holdout 0.2 --out runs/walks.h5
      swarmnet learn runs/walks.h5 --run runs/walks
    """

    data: Path
    """Trajectories written by `swarmnet import --holdout`."""
    run: Path = Path("runs/learned")
    """Run folder."""
    holdout: Path | None = None
    """Trajectories to judge on; NAME_holdout.h5 beside the data by default."""
    model: str = "crowd"
    """Preset of the model."""
    horizons: tuple[int, ...] = (1, 2, 5, 10)
    """Predicted steps in each stage of the curriculum."""
    stage_steps: tuple[int, ...] = (1000, 400, 200, 200)
    """Gradient steps in each stage."""
    scale: float = 1.0
    """Factor on the number of gradient steps of every stage."""
    seed: int = 0
    """Initial weights and data order."""
    videos: int = 3
    """Windows to make videos of."""

    def __post_init__(self) -> None:
        if not 0 < self.scale < float("inf"):
            raise SpecError("scale", self.scale, "a finite number above 0")
        if self.videos < 0:
            raise SpecError("videos", self.videos, "at least 0")


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Judge any policy on scenes it has never seen, beside a reference: contacts, collective motion, worst scenes.

    A policy is a run folder with a trained model, an expert by name, a Python function module:function, or a file of
    recorded trajectories, whose contacts are computed by replaying the positions. Policy and reference steer the agents
    in MuJoCo from the same starts; contacts are counted by the engine. A model's prediction error is measured, too,
    with persistence and constant velocity beside it. RUN gets rollouts/, figures/, videos/, the contact log,
    evaluation.json and report.html.

    With --data, nothing is steered and no physics runs: a model's prediction is judged on recorded trajectories, such
    as the held-out part of an import.

    A function is called as function(state, params, key) and returns accelerations (scenes, agents, 2) [m/s^2];
    module:make() calls make first, for a policy with settings. Modules of the working folder are found.

    Example:
      swarmnet evaluate runs/clear --scenes 200 --json evaluation.json
      swarmnet evaluate --policy helbing --preset clear
      swarmnet evaluate runs/mine --policy mymodule:policy --reference runs/clear
      swarmnet evaluate --policy recorded.h5 --log parquet
      swarmnet evaluate runs/walks --data runs/walks_holdout.h5
    """

    run: Path | None = None
    """Run folder: its trained model is judged unless --policy names another, and results are written there. Without it
    they go to runs/evaluate-POLICY."""
    policy: str | None = None
    """What to judge: a run folder, expert (the world's own) or an expert's name, module:function, or a .h5 file."""
    data: Path | None = None
    """Recorded trajectories (.h5) on which to judge a model's prediction, and nothing else."""
    reference: str = "expert"
    """What to judge it by, named in the same way; none for nothing."""
    scenes: int = 200
    """Unseen scenes, drawn from `seed`; of recorded trajectories, all."""
    steps: int = 50
    """Control steps per scene; of recorded trajectories, all."""
    seed: int = 1_000_000
    """Seed of the unseen scenes; must differ from the training data's."""
    preset: str | None = None
    """World to judge in; by default that of a model's training data or of a recording, else clear."""
    num_agents: int | None = None
    """Largest number of agents per scene; the world's own by default."""
    num_obstacles: int | None = None
    """Largest number of obstacles per scene; the world's own by default."""
    perception_noise: float | None = None
    """Standard deviation of noise on all that both policies see [m and m/s]; that of the training data by default."""
    actuation_noise: float | None = None
    """Standard deviation of noise on both policies' accelerations [m/s^2]; that of the training data by default."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx, mjx-warp."""
    log: Literal["csv", "parquet"] = "csv"
    """Format of the contact log."""
    videos: int = 3
    """Worst scenes to make videos of."""
    json: Path | None = None
    """Also write the results here, machine-readable."""


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

    With --engines, every engine that this machine has is checked against sphere geometry and against the others on
    random dense scenes, and the numbers of wrong and borderline contact flags are printed.

    Example:
      swarmnet doctor --engines
    """

    engines: bool = False
    """Check the physics engines (under 3 minutes on 2 cores)."""
    scenes: int = 100_000
    """Random scenes for --engines."""
    json: Path | None = None
    """Also write the results here, machine-readable."""


@dataclass(frozen=True, kw_only=True)
class Bench:
    """Measure: `engines` (scene-steps/s, as ratios to bare mujoco.batch), `experts` (cost per agent up to 1000 agents),
    `adapters` (Gymnasium, PettingZoo, dm_env, as ratios to the environment itself), `throughput` (10 agents and 5
    obstacles with random actions and resets, batches up to 32k on a GPU), `imitation` (simulate, train, prediction
    error), `train` (windows/s, the share of time in the compiled step, one core against Keras where it is installed),
    `rendering` (frame rates), `build` (scenes per second).

    Example:
      swarmnet bench engines --json docs/results/bench-engines.json
    """

    what: Literal["engines", "experts", "adapters", "throughput", "imitation", "train", "rendering", "build"]
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
    """throughput: scenes per batch; by default 64 and 512 on a CPU, 1024 to 32768 on a GPU."""
    scenes: int = 2000
    """imitation, train: training scenes."""
    scale: float = 0.8
    """imitation, train: factor on the number of gradient steps."""
    seed: int = 0
    """imitation, train: seed of data and weights."""
    json: Path | None = None
    """Also write the results here, machine-readable."""

    def __post_init__(self) -> None:
        for field in ("repeats", "scenes", "agents", "substeps", "batch"):
            value = getattr(self, field)
            if any(number < 1 for number in (value if isinstance(value, tuple) else (value,))):
                raise SpecError(field, value, "at least 1")


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


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Make a table or figure of the thesis anew: simulate, train, test, and set its figures beside ours.

    Without a name, lists them. A table is made of cells (row x data set x seed), each a job of its own that goes on
    where it was interrupted; the same command in two terminals shares them. Finished cells are merged into one JSON
    that names the missing ones.

    Example:
      swarmnet reproduce table-3.1 --profile quick
      swarmnet reproduce table-3.1 --profile cpu --rows "swarmnet best" --columns boids "boids dt0.1" --seeds 0
    """

    name: str | None = None
    """Table, figure or argument, such as table-3.1."""
    profile: Literal["quick", "cpu", "full"] = "quick"
    """quick: one seed, all of it in about 15 minutes on 2 cores, a smoke run that is not to be quoted. cpu: 3 seeds, 5
    minutes of training per cell. full: 50,000 demonstrations and an hour per cell, for a GPU."""
    rows: tuple[str, ...] = ()
    """Only these rows; all by default."""
    columns: tuple[str, ...] = ()
    """Only these columns or data sets; all by default."""
    seeds: tuple[int, ...] = ()
    """Seeds of data and weights; the profile's by default."""
    minutes: float | None = None
    """Training of one cell [min], the same for every row; the profile's by default."""
    merge_only: bool = False
    """Run nothing: merge, print and draw what is there."""
    out: Path = Path("runs/reproduce")
    """Folder for cells, data and results."""
    json: Path | None = None
    """File of the merged results; by default OUT/PROFILE/NAME.json."""

    def __post_init__(self) -> None:
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise SpecError("minutes", self.minutes, "a finite number above 0 [min]")
        if any(seed < 0 for seed in self.seeds):
            raise SpecError("seeds", self.seeds, "at least 0 each")


@dataclass(frozen=True, kw_only=True)
class Probe:
    """Look inside a trained SwarmNet: force fields of its edge functions, probes, contributions, figure 5.1.

    RUN gets probe.json and figures/probe-*.svg, figure-5.1.svg. True laws are shown where the expert is known.

    Example:
      swarmnet probe runs/clear
    """

    run: Path
    """Run folder with a trained model."""
    data: Path | None = None
    """Trajectories to look at; by default unseen scenes of the training world."""
    scenes: int = 100
    """Scenes to look at, at least 4."""
    scene: int = 0
    """Scene whose contributions are drawn over time."""
    seed: int = 1_000_000
    """Seed of unseen scenes and of the pairs that are probed."""
    walls_stay: bool = False
    """Figure 5.1: virtual walls act in every column, not only where the obstacle rule is on."""


Command = (
    Simulate
    | Merge
    | Train
    | Schedule
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
