"""The command line: one frozen dataclass per command, its docstring is its help. Standard library only."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Literal

from envs.config import SimulateConfig
from gnn.config import TrainConfig


@dataclass(frozen=True, kw_only=True)
class Simulate(SimulateConfig):
    """Simulate scenes with an expert in MuJoCo and record them.

    Writes one HDF5 file (positions, velocities, masks, contacts, provenance), whole or not at all. Chunks that are done
    are kept beside it until then: an interrupted call goes on where it was.

    Example:
      swarmnet simulate --preset clear --scenes 2000 --seed 0 --out runs/clear.h5
    """

    out: Path = Path("runs/trajectories.h5")
    """File to write."""


@dataclass(frozen=True, kw_only=True)
class Train(TrainConfig):
    """Train a SwarmNet on recorded trajectories, or go on with a run that was interrupted.

    The run folder gets checkpoints/, metrics.jsonl and tensorboard/. The curriculum predicts 1, 2, 5, then 10 steps.

    Example:
      swarmnet train runs/clear.h5 --run runs/clear --model best
    """

    data: Path
    """Trajectories written by `swarmnet simulate`."""
    run: Path = Path("runs/first")
    """Run folder."""
    validation: float = 0.05
    """Share of the scenes kept out of training, for the validation error in the metrics."""
    scale: float = 1.0
    """Factor on the number of gradient steps of every stage."""


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Judge a trained model on scenes it has never seen: prediction error by horizon, and closed loop in physics.

    The prediction table has persistence and constant velocity beside the model. In closed loop the model steers the
    agents in MuJoCo from the same starts as the expert; contacts are counted by the engine. Both are recorded in
    RUN/rollouts/, figures and report.html are renewed.

    Example:
      swarmnet evaluate runs/clear --scenes 200 --json evaluation.json
    """

    run: Path
    """Run folder with a trained model."""
    scenes: int = 200
    """Unseen scenes, drawn from `seed`."""
    steps: int = 50
    """Control steps per scene."""
    seed: int = 1_000_000
    """Seed of the unseen scenes; must differ from the training data's."""
    preset: str | None = None
    """World to judge in; the training data's own by default."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx."""
    json: Path | None = None
    """Also write the results here, machine-readable."""


@dataclass(frozen=True, kw_only=True)
class Render:
    """Make a video of recorded scenes, or of two recordings of the same scenes side by side.

    Needs no display. Without EGL a matplotlib renderer draws, and the message names the package to install.

    Example:
      swarmnet render runs/demo/rollouts/expert.h5 --beside runs/demo/rollouts/learned.h5 --scene 3
    """

    data: Path
    """Trajectories to show."""
    beside: Path | None = None
    """Other trajectories of the same scenes, shown on the right."""
    scene: int = 0
    """Which scene of the file."""
    camera: Literal["top", "tilted"] = "top"
    """View from above, or tilted."""
    size: int = 480
    """Height and width of a frame [pixels]."""
    renderer: Literal["auto", "mujoco", "matplotlib"] = "auto"
    """MuJoCo (OpenGL) or matplotlib; auto takes MuJoCo where it works."""
    speed: float = 2.0
    """Seconds of simulation per second of video."""
    out: Path = Path("video.mp4")
    """File to write: .mp4, or .gif."""


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
    """Physics engine: auto, native, mjx."""
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
    error), `rendering` (frame rates), `build` (scenes per second).

    Example:
      swarmnet bench engines --json docs/results/bench-engines.json
    """

    what: Literal["engines", "experts", "adapters", "throughput", "imitation", "rendering", "build"]
    """What to measure."""
    agents: tuple[int, ...] = (5, 10, 20, 100, 1000)
    """engines: numbers of agents, each with 1 obstacle."""
    substeps: tuple[int, ...] = (1, 15)
    """engines, throughput: physics steps per control step."""
    repeats: int = 3
    """engines, experts, adapters: interleaved repetitions; medians are printed."""
    engine: tuple[str, ...] = ("native", "mjx")
    """throughput: engines to measure."""
    batch: tuple[int, ...] = ()
    """throughput: scenes per batch; by default 64 and 512 on a CPU, 1024 to 32768 on a GPU."""
    scenes: int = 2000
    """imitation: training scenes."""
    scale: float = 0.8
    """imitation: factor on the number of gradient steps."""
    seed: int = 0
    """imitation: seed of data and weights."""
    json: Path | None = None
    """Also write the results here, machine-readable."""


Command = Simulate | Train | Evaluate | Render | Demo | Report | Doctor | Bench


def part_of[T](kind: type[T], config: object) -> T:
    """The fields of `config` that `kind` has, as a `kind`: a command without what only the command line needs."""
    own: Any = kind
    return kind(**{f.name: getattr(config, f.name) for f in fields(own)})
