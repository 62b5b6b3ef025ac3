"""Figures 5.2 to 5.4: an imitated swarm improved by PPO, by what is free to change, judged by contacts.

A policy is trained once, by whoever asks first, in OUT/PROFILE/policies/ROW/DATA/seed-S, a run folder like any other;
all three experiments judge it from there, without exploration.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from envs.collisions import NEAR_GOAL, collision_report, goal_distances
from envs.config import RewardConfig, SimulateConfig
from envs.estimates import Bootstrap
from envs.storage import load, save
from envs.swarm_env import SwarmEnv
from envs.trajectories import AGENT, Trajectories
from gnn.checkpoint import Model
from gnn.config import TrainConfig
from gnn.metrics import read_metrics
from gnn.train import split, train
from rl.config import MODES, PPOConfig
from rl.task import SwarmTask
from rl.train import train as improve
from swarmnet.closed_loop import Stage, roll_out
from swarmnet.commands import rl as rl_command
from swarmnet.commands.train import note
from swarmnet.figures_rl import final_return, first_reach, history, policy_sheet, return_history
from swarmnet.film import Panel
from swarmnet.policies import EXPERT, Source, find_policy
from swarmnet.progress import Update
from swarmnet.reproduce.cells import claim
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.lock import locked
from swarmnet.reproduce.shown import keep, small_print, write
from swarmnet.reproduce.work import TEST_SEED, VALIDATION, demonstrations, few, slug

PPO = PPOConfig(epochs=4, terminations=400)
"""Of every row; the seed is the cell's, what is frozen the row's, and the minutes of the effort end it. Episodes that
always go on are mostly about the few scenes in which somebody rubs along an obstacle, and teach slowly; those that
always end at a contact leave a policy that does not come away from what it touches."""
REWARD = RewardConfig(collision=50.0)
"""Five times the published price of a collision: at 10, policies buy their way to the goal with contacts of agents."""
STEPS = 60
"""Control steps of an episode, in training and in judging."""
WORLD = SimulateConfig(preset="clear", mixed=True, num_obstacles=3)
"""Of demonstrations, training and unseen scenes."""
FEW, LONGER, MANY = "1k", "1k longer", "10k"
IMITATION = {
    FEW: (1000, TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(3000,))),
    # Learned for longer it touches in 1.6 to 4.2% of control steps (asked: 1 to 4); from 10,000 in less than 0.1%.
    LONGER: (1000, TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(4500,))),
    MANY: (10_000, TrainConfig(model="thesis-ch5", horizons=(1,), stage_steps=(9000,))),
}
"""Demonstrations, and how the imitation policy learns from them."""
TESTED = 4
"""Unseen scenes for each that the effort names: 2000 in profiles cpu and full."""
LEAST = 0.5
"""Contact steps of the imitation policy [%] below which no ratio to its contacts counts."""

IMITATED, SCRATCH = "imitation", "scratch"
FREEZE = {SCRATCH: MODES[0]} | {f"mode {mode}": patterns for mode, patterns in MODES.items()}
"""What stays as it is in the rows that PPO trains."""
ROWS = (EXPERT, IMITATED, *FREEZE)
TERMINATIONS = {"mode 0, always to contact": None, "mode 0, always past contact": 0}
"""Rows beside mode 0 for whether contacts end episodes (`PPOConfig.terminations`)."""
TRAINED = FREEZE | dict.fromkeys(TERMINATIONS, MODES[0])
"""What stays as it is, for these rows too."""
TOUCHING, EVENTS, EVER = "contact steps [%]", "contact events", "trajectories with a contact [%]"
RATE, SUCCESS, DISTANCE = "contact events per agent and minute", "success [%]", "goal distance [m]"
MEASURED = (TOUCHING, EVENTS, EVER, RATE, SUCCESS, DISTANCE)
EVENT_RATIO, GOAL_RATIO, AWAY = "contact events / imitation", "goal distance / imitation", "MSE to imitation [m^2]"
RETURN, BUDGET = "final return", "env-steps"
REACHED, SHARE = "env-steps to scratch's return", "share of scratch's env-steps"
AWAY_SHOWN, SCENE = "MSE in the scene shown [m^2]", "scene"


@dataclass(frozen=True)
class Policies:
    """Who trains and runs the policies of one seed, from demonstrations of one size."""

    data: str
    """Of `IMITATION`."""
    seed: int
    effort: Effort
    folder: Path
    """OUT/PROFILE/policies."""
    progress: Update

    def place(self, row: str) -> Path:
        """Run folder of a row's policy. The one from random weights is the same whatever was demonstrated."""
        return Cell(row, FEW if row == SCRATCH else self.data, self.seed).path(self.folder)

    def imitated(self) -> Model:
        """The imitation policy, trained if need be; other processes wait for it."""
        size, config = IMITATION[self.data]
        config = replace(config, seed=self.seed)
        recorded = demonstrations(WORLD, replace(self.effort, demonstrations=size), self.seed)
        learning, validation = split(recorded, VALIDATION)

        def report(done: int, total: int, row: dict) -> None:
            self.progress(done, total, note(row))

        with locked(self.place(IMITATED) / "policy.lock", wait=True):
            return train(config, learning, self.place(IMITATED), validation=validation, progress=report)

    def improved(self, row: str) -> Model:
        """The policy of a row of `TRAINED`, trained if need be. Raises Busy where another process does that."""
        world, minutes, place = WORLD.world(), self.effort.minutes, self.place(row)
        env = SwarmEnv(world.scene, spawn=world.spawn, horizon=STEPS, terminate_on_contact=True)
        task = SwarmTask(env, REWARD)
        ends = TERMINATIONS.get(row, PPO.terminations)
        config = replace(PPO, seed=self.seed, freeze=TRAINED[row], terminations=ends, iterations=rl_command.ENDLESS)
        began = replace(self, data=FEW if row == SCRATCH else self.data).imitated()

        def report(done: int, total: int, found: dict) -> None:
            self.progress(round(found["spent"]), round(60 * minutes), rl_command.note(found))

        with locked(place / "policy.lock"):
            return improve(config, task, began, place, scratch=row == SCRATCH, minutes=minutes, progress=report)

    def source(self, row: str) -> Source:
        """The row's policy, trained if need be."""
        if row == EXPERT:
            return find_policy(EXPERT)
        return Source(given=row, name=row, model=self.imitated() if row == IMITATED else self.improved(row))

    def acted(self, row: str, world: SimulateConfig) -> Trajectories:
        """What the row's policy does in the unseen scenes of `world`, from the same starts as all others; recorded by
        whoever asks first."""
        config = replace(world, steps=STEPS, seed=TEST_SEED)
        path = self.place(row) / "acted" / f"{slug(config)}.h5"
        if not path.exists():
            source = self.source(row)
            with locked(path.with_suffix(".lock"), wait=True):
                if not path.exists():
                    save(path, roll_out(Stage.of(config), source, title=f"{row} in physics"))
        return load(path)

    def judged(self, row: str, world: SimulateConfig, folder: Path) -> dict[str, float]:
        """`measured`; for a row of `TRAINED` also `compared` with the imitation policy, and one scene of both kept."""
        acted = self.acted(row, world)
        if row not in TRAINED:
            return measured(acted)
        imitation = self.acted(IMITATED, world)
        one, other = (t.take([telling(imitation)]) for t in (acted, imitation))
        keep(folder, SCENE, other, one)
        return measured(acted) | compared(acted, imitation) | {AWAY_SHOWN: apart(one, other)}


def policies_of(cell: Cell, data: str, effort: Effort, place: Path, progress: Update) -> Policies:
    """For the cell in folder `place`. Raises SwarmError where policies were trained for other minutes."""
    folder = place.parents[3] / "policies"
    claim(folder, effort)
    return Policies(data, cell.seed, effort, folder, progress)


def interval(name: str) -> tuple[str, str, str]:
    """Columns of a figure and of the ends of its interval."""
    return name, f"{name}, low", f"{name}, high"


def measured(t: Trajectories) -> dict[str, float]:
    """`MEASURED` with 95% intervals over scenes. An event is the beginning of an agent's contact; a success is a scene
    in which every agent comes within 15 m of the goal and nothing ever touches."""
    report, bootstrap, scenes = collision_report(t), Bootstrap(len(t), 0), np.ones(len(t))
    present = t.mask & (t.kind == AGENT)[:, None]
    events = ((t.agent_events + t.solid_events) * present)[:, 1:].sum(axis=(1, 2))
    near = (goal_distances(t)[0] <= NEAR_GOAL) & present
    arrived = (near.any(axis=1) | ~present.any(axis=1)).all(axis=1)
    found = {
        TOUCHING: report["contact_steps_any"],
        EVENTS: bootstrap.ratio(events, scenes, ""),
        EVER: report["ever_touching_trajectories_any"],
        RATE: bootstrap.ratio(events, present[:, 1:].sum(axis=(1, 2)) * t.dt / 60, "1/min"),
        SUCCESS: bootstrap.ratio(arrived & ~touching(t).any(axis=(1, 2)), scenes, "share"),
        DISTANCE: report["final_goal_distance"],
    }
    values = {}
    for name, figure in found.items():
        for column, value in zip(interval(name), (figure.value, figure.low, figure.high), strict=True):
            values[column] = np.nan if value is None else value * (100 if figure.unit == "share" else 1)
    return values


def compared(acted: Trajectories, imitation: Trajectories) -> dict[str, float]:
    """Beside the imitation policy in the same scenes; no ratio of contacts where that one hardly touches."""
    mine, its = measured(acted), measured(imitation)
    ratio = {EVENT_RATIO: mine[EVENTS] / its[EVENTS]} if its[TOUCHING] >= LEAST else {}
    return {**ratio, GOAL_RATIO: mine[DISTANCE] / its[DISTANCE], AWAY: apart(acted, imitation)}


def apart(one: Trajectories, other: Trajectories) -> float:
    """Mean squared distance [m^2] between the same agents, which start in one place, over all later rows."""
    there = (one.mask & other.mask & (one.kind == AGENT)[:, None])[:, 1:]
    square = np.sum((one.position - other.position)[:, 1:] ** 2, axis=-1, dtype=np.float64)
    return float(square[there].mean())


def touching(t: Trajectories) -> Bool[np.ndarray, "S T V"]:
    """Whether a node touches something in the control step that ends in a row."""
    return (t.agent_contact > 0) | (t.solid_contact > 0)


def telling(imitation: Trajectories) -> int:
    """The scene that is drawn: the first with everybody there in which the imitation policy touches an obstacle, or
    else anything, or else the first."""
    rank = 1 + touching(imitation).any(axis=(1, 2)) + (imitation.solid_contact > 0).any(axis=(1, 2)).astype(int)
    return int(np.argmax(rank * imitation.mask.all(axis=(1, 2))))


def until_contact(t: Trajectories) -> Trajectories:
    """One scene, which ends with the first control step in which anything touches."""
    hit = touching(t).any(axis=(0, 2))
    last = int(np.argmax(hit)) if hit.any() else len(hit) - 1
    mask = t.mask & (np.arange(len(hit)) <= last)[:, None]
    return replace(t, mask=mask, position=t.position * mask[..., None], velocity=t.velocity * mask[..., None])


def learned(policies: Policies, row: str) -> dict[str, float]:
    """The final return, and for a mode where it first reaches that of `scratch` with the same seed, when that one is
    finished: in env-steps, and as a share of the env-steps of `scratch`; NaN where never."""
    rows, scratch = (read_metrics(policies.place(name) / "metrics.jsonl") for name in (row, SCRATCH))
    found = {RETURN: final_return(rows), BUDGET: rows[-1]["env_steps"]}
    if row != SCRATCH and scratch and scratch[-1]["spent"] >= 60 * policies.effort.minutes:
        found[REACHED] = first_reach(history(rows), final_return(scratch))
        found[SHARE] = found[REACHED] / scratch[-1]["env_steps"]
    return found


def run_5_2(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Trains the row's policy and judges it on unseen scenes."""
    if effort.profile == "quick" and not FIGURE_5_2.in_quick(cell.row, cell.data):
        return {}
    policies = policies_of(cell, cell.data, effort, folder, progress)
    found = policies.judged(cell.row, replace(WORLD, scenes=TESTED * effort.test_scenes), folder)
    found |= learned(policies, cell.row) if cell.row in TRAINED else {}
    return _titled(cell.data, found, FIGURE_5_2)


def draw_5_2(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Returns of all seeds over env-steps and over minutes, and contact events of all rows."""
    done = [(cell, record) for cell, record in done if record["values"] and cell.row in ROWS]
    curves, events = {}, {}
    order = list(IMITATION)
    for cell, record in sorted(done, key=lambda at: (order.index(at[0].data), ROWS.index(at[0].row), at[0].seed)):
        name = cell.row if cell.data == FEW else f"{cell.row}, {cell.data}"
        events.setdefault(name, []).append(record["values"][f"{cell.data}: {EVENTS}"])
        if cell.row in FREEZE:
            rows = read_metrics(cell.path(folder.parent / "policies") / "metrics.jsonl")
            curves.setdefault(name, {})[cell.seed] = history(rows)
    trained = [(cell, record) for cell, record in done if cell.row in FREEZE]
    seeds = sorted({cell.seed for cell, _ in trained})
    both = any(cell.data == MANY for cell, _ in trained)
    words = _words(trained[0][1], seeds, sizes=(FEW, MANY) if both else (FEW,)) if trained else ""
    if trained and PPO.terminations:
        words += f"; contacts end episodes in the first {PPO.terminations} iterations"
    if not done:
        return []
    return write(folder, "figure-5.2", return_history(curves, events, note=words))


CROWDS = {f"{agents} agents": agents for agents in (10, 20, 50)}
ZERO_SHOT = {name: replace(WORLD, num_agents=agents, mixed=False) for name, agents in CROWDS.items()} | {
    start: replace(WORLD, start=start) for start in ("corridor", "crossing")
}
"""Scenes of kinds that no policy was trained in."""


def run_5_3(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Judges figure 5.2's policies, of column `1k longer`, in scenes of a kind that they were not trained in."""
    world, most = ZERO_SHOT[cell.data], replace(effort, test_scenes=TESTED * effort.test_scenes)
    scenes = few(most, world.num_agents).test_scenes if cell.data in CROWDS else most.test_scenes
    found = policies_of(cell, LONGER, effort, folder, progress).judged(cell.row, replace(world, scenes=scenes), folder)
    return _titled(cell.data, found, FIGURE_5_3)


def draw_5_3(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Ten agents: mode 0 of the first seed over the imitation policy's ways, which end with its first contact."""
    shown = [pair for pair in done if (pair[0].row, pair[0].data) == ("mode 0", "10 agents")]
    if not shown:
        return []
    cell, record = min(shown, key=lambda pair: pair[0].seed)
    imitation, acted = _kept(cell.path(folder))
    panel = Panel(acted, f"mode 0; {IMITATED} until its first contact", until_contact(imitation), IMITATED)
    figure = policy_sheet([panel], columns=1, width="column", note=_words(record, [cell.seed]))
    return write(folder, "figure-5.3", figure)


def run_5_4(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """How far a mode's policy goes from the imitation policy, in all unseen scenes and in the one that is drawn."""
    policies = policies_of(cell, cell.data, effort, folder, progress)
    found = policies.judged(cell.row, replace(WORLD, scenes=TESTED * effort.test_scenes), folder)
    return _titled(cell.data, found, FIGURE_5_4)


def draw_5_4(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Every mode in one scene, of the first seed that has them all."""
    modes = [row for row in FIGURE_5_4.rows if row in FREEZE]
    records = {(cell.seed, cell.row): (cell, record) for cell, record in done if cell.row in modes}
    whole = [seed for seed, _ in sorted(records) if all((seed, row) in records for row in modes)]
    if not whole:
        return []
    panels = []
    for row in modes:
        cell, record = records[whole[0], row]
        imitation, acted = _kept(cell.path(folder))
        title = f"{row}, MSE {record['values'][f'{cell.data}: {AWAY_SHOWN}']:.3g} m²"
        panels.append(Panel(acted, title, imitation, IMITATED))
    words = _words(records[whole[0], modes[0]][1], whole[:1])
    return write(folder, "figure-5.4", policy_sheet(panels, columns=len(panels), note=words))


def _titled(data: str, found: dict[str, float], experiment: Experiment) -> dict[str, float]:
    """Those that the experiment has columns for, such as `1k: contact events`."""
    named = {f"{data}: {name}": value for name, value in found.items()}
    return {column: float(value) for column, value in named.items() if column in experiment.columns}


def _kept(place: Path) -> tuple[Trajectories, Trajectories]:
    """The scene of a cell that is drawn: imitation policy, and its own."""
    imitation, acted = (load(place / "shown" / f"{SCENE}-{what}.h5") for what in ("truth", "predicted"))
    return imitation, acted


def _words(record: dict, seeds: Sequence[int], sizes: Sequence[str] = (FEW,)) -> str:
    numbers = " or ".join(f"{IMITATION[size][0]}" for size in sizes)
    return small_print(record, data=f"imitation from {numbers} demonstrations", seeds=seeds)


class Borrowing(Experiment):
    """An experiment whose policies are figure 5.2's: a policy has the minutes of a cell there."""

    def effort(self, profile: str, data: Path, minutes: float | None = None) -> Effort:
        """See `Experiment.effort`."""
        return FIGURE_5_2.effort(profile, data, minutes)


def _columns(data: str, *names: str) -> DataSet:
    return DataSet(data, tuple(f"{data}: {name}" for name in names))


_JUDGED = (
    "Judged in 60 control steps without exploration; all rows start from the same places. An event is the beginning of "
    "an agent's contact (two agents that meet are two); `low`, `high`: 95% bootstrap interval over scenes; success: "
    "every agent comes within 15 m of the goal and nothing touches. Ratios to the imitation policy's contacts are left "
    f"out where it touches in less than {LEAST}% of control steps."
)
FIGURE_5_2 = Experiment(
    name="figure-5.2",
    about="PPO from scratch and from imitation (modes 0, 1, 2): return, contacts on unseen scenes, way from imitation",
    rows=(*ROWS, *TERMINATIONS),
    data_sets=tuple(
        _columns(
            data, *(column for name in MEASURED for column in interval(name)), EVENT_RATIO, GOAL_RATIO, AWAY, RETURN,
            BUDGET, REACHED, SHARE,
        )
        for data in IMITATION
    ),
    run=run_5_2,
    size=lambda cell, effort: IMITATION[cell.data][0],
    leading=(IMITATED, SCRATCH),
    untrained=(EXPERT,),
    exists=lambda row, data: data == FEW or row not in (EXPERT, SCRATCH, *TERMINATIONS),
    in_quick=lambda row, data: data == FEW and row not in TERMINATIONS,
    unit="as named",
    notes="`1k`, `10k`: demonstrations of the imitation policy; `1k longer`: "
    f"{IMITATION[LONGER][1].stage_steps[0]} gradient steps from them instead of {IMITATION[FEW][1].stage_steps[0]}. "
    f"{_JUDGED} Final return: last tenth of the iterations; where a mode first reaches that of `scratch` of the same "
    "seed, with the mean return of ten iterations: no number where it does not. Contacts end episodes in the first "
    f"{PPO.terminations} iterations, in two rows always and never. Profile quick: neither those rows nor another "
    "column than `1k`.",
    figure=draw_5_2,
)  # fmt: skip
FIGURE_5_3 = Borrowing(
    name="figure-5.3",
    about="policies of figure 5.2 with 10, 20 and 50 agents and in harder scenes, none of which they have seen",
    rows=ROWS,
    data_sets=tuple(
        _columns(
            data, *interval(TOUCHING), *interval(EVENTS), EVER, RATE, *(() if data in CROWDS else (SUCCESS,)), DISTANCE,
            EVENT_RATIO, GOAL_RATIO,
        )
        for data in ZERO_SHOT
    ),
    run=run_5_3,
    size=lambda cell, effort: IMITATION[LONGER][0],
    leading=(IMITATED, "mode 0"),
    untrained=(EXPERT,),
    unit="as named",
    notes=f"Policies of figure 5.2, column `{LONGER}`, which have seen 1 to 5 agents. {_JUDGED} Crowds have no room "
    "within 15 m of the goal.",
    figure=draw_5_3,
)  # fmt: skip
FIGURE_5_4 = Borrowing(
    name="figure-5.4",
    about="how far the policies of modes 0, 1, 2 go from the imitation policy, in all unseen scenes and in one",
    rows=tuple(row for row in ROWS if row != SCRATCH),
    data_sets=(_columns(LONGER, *interval(TOUCHING), AWAY, AWAY_SHOWN),),
    run=run_5_4,
    size=lambda cell, effort: IMITATION[LONGER][0],
    leading=(IMITATED,),
    untrained=(EXPERT,),
    unit="as named",
    notes=f"Policies of figure 5.2, column `{LONGER}`. MSE: mean squared distance of the same agents from the same "
    f"start. {_JUDGED}",
    figure=draw_5_4,
)
