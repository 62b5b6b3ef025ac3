"""The command line of learning, judging and reproducing; see `swarmnet.config`. Standard library only."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from envs.config import RewardConfig
from gnn.config import TrainConfig
from rl.config import PPOConfig
from swarm_mjcf.errors import SpecError


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
class RL(PPOConfig):
    """Improve a trained SwarmNet by PPO in MuJoCo, with a reward for the goal and against contacts, or go on with it.

    The imitated policy becomes the mean of a Gaussian, a second readout learns the value. Modes as in the thesis: 0
    frees all weights, 1 freezes the goal's edge function, 2 frees the edge functions of obstacles and agents alone.
    Scenes are those of the data that the model was trained on, with fresh starts. RUN gets checkpoints/ (a model like
    any other), metrics.jsonl, tensorboard/, videos of both policies in the same unseen scenes, and report.html.

    Example:
      swarmnet simulate --preset clear --mixed --num-obstacles 3 --scenes 1000 --out runs/few.h5
      swarmnet train runs/few.h5 --run runs/few --model thesis-ch5
      swarmnet rl runs/few --run runs/few-rl --mode 2 --minutes 10
    """

    init: Path
    """Run folder with the trained model: preset thesis-ch5 or best."""
    run: Path = Path("runs/improved")
    """Run folder."""
    mode: Literal[0, 1, 2] = 0
    """What stays as it is, besides what --freeze names."""
    scratch: bool = False
    """Start from random weights of the model's preset: what imitation is worth."""
    minutes: float | None = None
    """Wall time of the training, compilation included, in place of --iterations."""
    horizon: int = 60
    """Control steps per episode."""
    terminate_on_contact: bool = False
    """End an episode at any contact (--terminations: in the first iterations); otherwise a contact costs and the scene
    goes on."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    """Coefficients of the reward."""
    engine: str = "auto"
    """Physics engine: auto, native, mjx, mjx-warp."""
    devices: int | None = None
    """Devices of every process that share the scenes; all by default."""
    coordinator: str | None = None
    """Several machines: HOST:PORT of process 0, as the others reach it. Under SLURM's srun nothing is to be given."""
    processes: int | None = None
    """Several machines: how many processes there are; each runs this same command."""
    process: int | None = None
    """Several machines: which of them this is, from 0."""
    test_scenes: int = 200
    """Unseen scenes that both policies are judged on in the end; 0: none."""
    videos: int = 3
    """Worst scenes to make videos of."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise SpecError("minutes", self.minutes, "a finite number above 0")
        if self.terminations is not None and not self.terminate_on_contact:
            raise SpecError("terminations", self.terminations, "none without --terminate-on-contact")
        for name, least in (("horizon", 1), ("test_scenes", 0), ("videos", 0)):
            if getattr(self, name) < least:
                raise SpecError(name, getattr(self, name), f"at least {least}")


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
        for name in ("scenes", "steps_per_scene", "test_scenes"):
            if getattr(self, name) < 1:
                raise SpecError(name, getattr(self, name), "at least 1")
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
      swarmnet evaluate runs/near --policy runs/clear --nearest 3 --reference runs/clear
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
    nearest: int | None = None
    """Run the model decentralised: each agent on its own, perceiving only this many others, the nearest. Judge it by
    the centralised model (--reference RUN) to see what is lost."""
    radius: float | None = None
    """The same with others and obstacles closer than this alone [m]; with --nearest, both hold."""
    filter: Literal["barrier", "disc", "polygon", "diamond", "roll-out"] | None = None
    """Put a run-time filter around the policy: what the constraint does not allow becomes the nearest action that it
    does, and where there is none, agents turn (`swarmnet repair --help` names the constraints)."""
    filter_margin: float = 0.0
    """Of the filter: kept between surfaces beyond touching [m]."""
    filter_share: float = 0.7
    """Of the filter barrier: part of the largest acceleration counted on for braking."""
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
    horizons: tuple[int, ...] = (1, 2, 5, 10, 20)
    """Predicted steps in each stage of the curriculum; stages that do not fit into the recorded scenes are left out."""
    stage_steps: tuple[int, ...] = (1000, 400, 200, 200, 200)
    """Gradient steps in each stage."""
    scale: float = 1.0
    """Factor on the number of gradient steps of every stage."""
    seed: int = 0
    """Initial weights and data order."""
    videos: int = 3
    """Windows to make videos of."""
    json: Path | None = None
    """Also write the results here, machine-readable."""

    def __post_init__(self) -> None:
        if not 0 < self.scale < float("inf"):
            raise SpecError("scale", self.scale, "a finite number above 0")
        if self.videos < 0:
            raise SpecError("videos", self.videos, "at least 0")


@dataclass(frozen=True, kw_only=True)
class Probe:
    """Look inside a trained SwarmNet: force fields of its edge functions, probes, contributions, figure 5.1.

    RUN gets probe.json and figures/probe-*.svg, figure-5.1.svg. True laws are shown where the expert is known.

    Example:
      swarmnet probe runs/clear
      swarmnet probe runs/walks --data runs/walks_holdout.h5
    """

    run: Path
    """Run folder with a trained model."""
    data: Path | None = None
    """Trajectories to look at, simulated or imported; by default unseen scenes of the training world, or the recording
    that the model learned from."""
    scenes: int = 100
    """Scenes to look at; the linear probe needs 4."""
    scene: int = 0
    """Scene whose contributions are drawn over time."""
    seed: int = 1_000_000
    """Seed of unseen scenes and of the pairs that are probed."""
    walls_stay: bool = False
    """Figure 5.1: virtual walls act in every column, not only where the obstacle rule is on."""


UNSEEN = 1_000_000
"""Seeds from here on are those of scenes to test on."""


@dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Make a table or figure of the thesis anew: simulate, train, test, and set its figures beside ours.

    Without a name, lists them. A table is made of cells (row x data set x seed), each a job of its own that goes on
    where it was interrupted; the same command in two terminals shares them. Finished cells are merged into one JSON
    that names the missing ones, and that another machine can go on from.

    Example:
      swarmnet reproduce table-3.1 --profile quick
      swarmnet reproduce table-3.1 --profile cpu --rows "swarmnet best" --columns boids "boids dt0.1" --seeds 0
      swarmnet reproduce figure-3.7 --profile cpu --minutes 2 --known docs/results/figure-3.7.json
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
    jobs: int | None = None
    """Processes that share the cells; 1 by default, but 2 in profile quick. More train less in the same minutes where
    they have no cores of their own."""
    known: tuple[Path, ...] = ()
    """Results (JSON of this command, same profile and minutes) whose cells count as done: those of other machines, or
    of docs/results. Figures are drawn of the cells that ran in OUT."""
    merge_only: bool = False
    """Run nothing: merge, print and draw what is there."""
    out: Path = Path("runs/reproduce")
    """Folder for cells, data and results."""
    json: Path | None = None
    """File of the merged results; by default OUT/PROFILE/NAME.json."""

    def __post_init__(self) -> None:
        if self.minutes is not None and not 0 < self.minutes < float("inf"):
            raise SpecError("minutes", self.minutes, "a finite number above 0 [min]")
        if any(not 0 <= seed < UNSEEN for seed in self.seeds):
            raise SpecError("seeds", self.seeds, f"in 0..{UNSEEN - 1} each: larger ones are of unseen scenes")
        if self.jobs is not None and self.jobs < 1:
            raise SpecError("jobs", self.jobs, "at least 1")
