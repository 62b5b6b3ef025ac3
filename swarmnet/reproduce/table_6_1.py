"""Table 6.1: collisions before and after repair, by every method, beside the run-time filter.

Networks (one per seed) are imitated from 2000 demonstrations. A policy is repaired once, by whoever asks first, in
OUT/PROFILE/repaired/ROW/seed-S; the cells judge it in the thesis's scenes (5 agents, 1 obstacle) and in others.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from envs.config import SimulateConfig, World, mixed
from envs.estimates import Bootstrap
from envs.record import Array
from envs.trajectories import Trajectories
from gnn.checkpoint import Model, load_model
from gnn.config import TrainConfig
from gnn.decode import make_policy
from gnn.train import split, train
from gnn.windows import Dataset, windows
from repair.certify import Effort as Work
from repair.certify import certify
from repair.config import ConstraintConfig, DescentConfig, LoopConfig
from repair.constraints.barrier import Barrier
from repair.constraints.disc import Disc
from repair.constraints.registry import make_constraint
from repair.encounters import encounters
from repair.errors import RepairError
from repair.filter import make_filtered, shielded
from repair.limits import executed
from repair.loop import Repaired, repair
from repair.lost import lost
from repair.network import actions
from repair.ring import Box, Region, Ring
from repair.screen import Acted, decisions, least, screen
from repair.verify import clopper_pearson
from swarmnet.acting import make_perform
from swarmnet.commands.repair import SCENES, keep, note
from swarmnet.commands.train import note as training_note
from swarmnet.figures_repair import pareto
from swarmnet.policies import EXPERT, find_policy
from swarmnet.progress import Update
from swarmnet.reproduce.experiment import Cell, DataSet, Effort, Experiment
from swarmnet.reproduce.figures_5 import interval
from swarmnet.reproduce.lock import locked
from swarmnet.reproduce.shown import small_print, write
from swarmnet.reproduce.work import TEST_SEED, VALIDATION, demonstrations, published_mean, recordings
from swarmnet.results import write_whole

LEARNED = SimulateConfig(preset="clear", mixed=True, num_obstacles=3)
"""Of the demonstrations: 1 to 5 agents, 0 to 3 obstacles."""
DEMONSTRATIONS = 2000
CROWD = 20
"""Agents of the row that is repaired in crowds, at most."""
TRAINING = TrainConfig(model="thesis-ch5-small", horizons=(1,), stage_steps=(9000,))
THESIS = SimulateConfig(preset="clear", num_agents=5, num_obstacles=1)
"""Chapter 6's scenes."""
STEPS = 50
TESTED = 1000
"""Unseen scenes."""
MUST = ConstraintConfig()
"""What ours has to keep: the braking barrier, of obstacles and of agents."""
LOOPED = LoopConfig()
SHIELD = replace(MUST, margin=MUST.margin + LOOPED.reserve_margin, share=MUST.share * LOOPED.reserve_share)
"""What the run-time filter keeps: with the same in reserve as what the loop learns. Where that allows nothing it turns
at once: keeping what must hold as long as that is possible left 2 contacts in 10,000 trajectories instead of none."""
EDGES, NODES = ("edge/obstacle/layer2/*", "edge/agent/layer2/*"), ("node/*", "readout/*")

IMITATED, REPLICA, READOUT, EDGE, EDGE_NODE = (
    "imitation", "thesis replica", "last layer, true disc", "edge functions", "edge + node",
)  # fmt: skip
LOOP, CROWDS, PENALTY, FILTER, BOTH = (
    "counter-example loop", "loop in crowds", "Adam penalty", "filter", "repaired + filter",
)  # fmt: skip
LOOPS: dict[str, LoopConfig] = {
    # As in chapter 6: 1000 states, obstacles alone, an L1 diamond, L1 deviation.
    REPLICA: LoopConfig(
        method="thesis", constraint=ConstraintConfig(name="diamond"), agents=False, scenes=100, rounds=1
    ),
    READOUT: LoopConfig(method="last-layer", constraint=ConstraintConfig(name="disc"), scenes=100),
    EDGE: LoopConfig(method="relax", free=EDGES, polish=(), rounds=4),
    EDGE_NODE: LoopConfig(method="relax", free=(*EDGES, *NODES), polish=(), rounds=4),
    LOOP: LOOPED,
    # The same in fewer scenes of up to 20 agents.
    CROWDS: LoopConfig(scenes=128),
    # The same weights and gradient steps, all in the imitation policy's own states, towards its own actions.
    PENALTY: LoopConfig(rounds=1, targets="own", polish=(), descent=DescentConfig(steps=18_000)),
}
ROWS = (EXPERT, IMITATED, REPLICA, READOUT, EDGE, EDGE_NODE, LOOP, CROWDS, PENALTY, FILTER, BOTH)

LEAST = 0.5
"""Contact steps of the imitation policy [%] below which no ratio to them counts."""
TOUCHING, BETWEEN, SOLID = "contact steps [%]", "agent-agent contact steps [%]", "agent-obstacle contact steps [%]"
EVER, DISTANCE = "trajectories with a contact [%]", "goal distance [m]"
RATIO, AWAY = "contact steps / imitation", "goal distance / imitation"
THESIS_COLUMNS = tuple(
    f"{part} {what}" for part in ("train", "test") for what in ("steps [%]", "trajs [%]", "MSE [m^2]")
)
ONE_STEP, AVOIDABLE = "test decisions into an obstacle in one step [%]", "avoidable violations of the barrier [%]"
DEVIATION, INTRODUCED = "10-step error / imitation", "introduced violations [%]"
ROWS_GIVEN, ROWS_LEFT, SECONDS, GAP = "constrained rows", "constrained rows violated", "seconds", "gap [%]"
MAIN = (
    *THESIS_COLUMNS, ONE_STEP, AVOIDABLE, *interval(TOUCHING), *interval(BETWEEN), *interval(SOLID), EVER, DISTANCE,
    RATIO, AWAY, DEVIATION, INTRODUCED, ROWS_GIVEN, ROWS_LEFT, SECONDS, GAP,
)  # fmt: skip
CERTIFIED = "certificate"
SHARES = (
    "proven [%]", "counter-example [%]", "undecided [%]", "unavoidable [%]", "at least proven of what is up to it [%]",
    "seconds",
)  # fmt: skip
MANY, TIMES, MANY_SEED = "many trajectories", 10, 4_000_000
"""Ten times as many of the thesis's scenes, of another seed. One choice was made by them: the filter turns at once."""
TOUCHED, LOST, AVOIDED, AT_MOST = (
    "with a contact", "lost at the start", "with a contact, not lost", "at most, not lost [%]",
)  # fmt: skip
OF_MANY = tuple(f"{MANY}: {name}" for name in (TOUCHED, LOST, AVOIDED, AT_MOST, DISTANCE))
OTHERS = {
    "10 agents": replace(THESIS, num_agents=10),
    "20 agents": replace(THESIS, num_agents=20),
    "3 obstacles": replace(THESIS, num_obstacles=3),
}
"""Other kinds of scenes: the loop acts among 3 to 5 agents and 1 to 3 obstacles, the loop in crowds among 3 to 20."""


def learned_from(effort: Effort) -> int:
    """Demonstrations of the imitation policy."""
    return min(DEMONSTRATIONS, effort.demonstrations)


Facts = dict[str, float]
"""Columns that a method fills by itself."""


@dataclass(frozen=True)
class Policies:
    """The policies of one seed."""

    seed: int
    effort: Effort
    folder: Path
    """OUT/PROFILE/repaired."""
    progress: Update

    def place(self, row: str) -> Path:
        """A row's run folder."""
        return self.folder / row / f"seed-{self.seed}"

    def imitated(self) -> Model:
        """The network that is repaired."""
        place, config = self.place(IMITATED), replace(TRAINING, seed=self.seed)
        effort = replace(self.effort, demonstrations=learned_from(self.effort))
        recorded = demonstrations(LEARNED, effort, self.seed)
        learning, validation = split(recorded, VALIDATION)

        def report(done: int, total: int, row: dict) -> None:
            self.progress(done, total, training_note(row))

        with locked(place / "policy.lock", wait=True):
            return train(config, learning, place, validation=validation, progress=report)

    def policy(self, row: str) -> tuple[Model, Facts]:
        """A row's network, and what its method said of it; repaired once, so that all cells judge the same."""
        model, place = self.imitated(), self.place(row)
        if row in (IMITATED, FILTER):
            return model, {}
        if row == BOTH:
            return self.policy(LOOP)[0], {}
        with locked(place / "policy.lock", wait=True):
            if not (place / FACTS).exists():
                found, facts, how = self._repaired(row, model)
                keep(place, model, how, found)
                write_whole(place / FACTS, json.dumps(facts))
        return load_model(place / "checkpoints"), json.loads((place / FACTS).read_text())

    def _repaired(self, row: str, model: Model) -> tuple[Repaired, Facts, LoopConfig]:
        how = replace(LOOPS[row], seed=self.seed)
        if self.effort.profile == "quick":
            how = replace(how, rounds=min(how.rounds, 2), scenes=128, descent=replace(how.descent, steps=1000))
        # Ours acts in the demonstrations' fuller scenes, the methods of one step in the thesis's.
        world = THESIS.world()
        if row not in (REPLICA, READOUT):
            fuller = replace(LEARNED, num_agents=CROWD) if row == CROWDS else LEARNED
            world = mixed(fuller.world(), min_agents=3, min_obstacles=1)
        perform = make_perform(model, world, scenes=how.scenes, steps=how.steps, seed=SCENES + how.seed)

        def report(done: int, total: int, found: dict) -> None:
            self.progress(done, total, f"{row}: {note(found)}")

        found = repair(model, how, world.scene, perform, folder=self.place(row) / "rounds", progress=report)
        facts = {ROWS_GIVEN: found.verification.rows, ROWS_LEFT: found.verification.avoidable, SECONDS: found.seconds}
        if found.gap is not None:
            facts[GAP] = 100 * found.gap
        return found, facts, how

    def acted(self, row: str, model: Model, world: World, scenes: int, seed: int) -> Acted:
        """What the row's policy does from the first states of a seed."""
        policy = make_policy(model.config, model.scales, goal=world.scene.goal)
        if row in (FILTER, BOTH):
            constraint = make_constraint(SHIELD, world.scene)
            policy = make_filtered(policy, constraint, world.scene, world.scene, goal=world.scene.goal)
        if row == EXPERT:
            policy, _ = find_policy(EXPERT).policy(world)
        return make_perform(model, world, scenes=scenes, steps=STEPS, seed=seed, policy=policy)(model.params, 0)


FACTS = "facts.json"


# ---- judging -------------------------------------------------------------------------------------------------------


def outcome(acted: Acted) -> dict[str, float]:
    """Contacts in physics, with 95% intervals over scenes, and the final distance to the goal."""
    agent, solid = np.asarray(acted.touching_agent), np.asarray(acted.touching_obstacle)
    steps, bootstrap = np.full(len(agent), agent.shape[1]), Bootstrap(len(agent), 0)
    found = {}
    for name, touching in ((TOUCHING, agent | solid), (BETWEEN, agent), (SOLID, solid)):
        share = bootstrap.ratio(touching.any(axis=2).sum(axis=1), steps, "share")
        for column, value in zip(interval(name), (share.value, share.low, share.high), strict=True):
            found[column] = math.nan if value is None else 100 * value
    found[EVER] = 100 * float((agent | solid).any(axis=(1, 2)).mean())
    last, agents = np.asarray(acted.nodes)[:, -1], agent.shape[2]
    found[DISTANCE] = float(np.linalg.norm(last[:, -agents:, :2] - last[:, :1, :2], axis=-1).mean())
    return found


def beside(found: dict[str, float], imitation: dict[str, float]) -> dict[str, float]:
    """As ratios to the imitation policy in the same scenes; none to contacts in less than 0.5% of control steps."""
    ratio = {RATIO: found[TOUCHING] / imitation[TOUCHING]} if imitation[TOUCHING] >= LEAST else {}
    return {**ratio, AWAY: found[DISTANCE] / imitation[DISTANCE]}


def thesis_figures(acted: Acted) -> tuple[float, float]:
    """Shares [%] of control steps and of trajectories in which any agent touches the obstacle, as chapter 6 counts."""
    touching = np.asarray(acted.touching_obstacle).any(axis=2)
    return 100 * float(touching.mean()), 100 * float(touching.any(axis=1).mean())


def run_6_1(cell: Cell, effort: Effort, folder: Path, progress: Update) -> dict[str, float]:
    """Repairs, if nobody has, and judges the row's policy."""
    policies = Policies(cell.seed, effort, folder.parents[3] / "repaired", progress)
    model, facts = policies.policy(IMITATED if cell.row == EXPERT else cell.row)
    quick = effort.profile == "quick"
    if cell.data == CERTIFIED:
        return certified(model, seconds=10.0 if quick else CERTIFYING)
    scenes = 100 if quick else TESTED
    if cell.data == MANY:
        world = THESIS.world()
        return many(policies.acted(cell.row, model, world, TIMES * scenes, MANY_SEED), world)
    world = {"thesis": THESIS, **OTHERS}[cell.data].world()
    if cell.data != "thesis":
        scenes = max(scenes // 4, 1)
    test = policies.acted(cell.row, model, world, scenes, TEST_SEED)
    imitation = (
        test if cell.row == IMITATED else policies.acted(IMITATED, policies.imitated(), world, scenes, TEST_SEED)
    )
    found = outcome(test)
    found |= beside(found, outcome(imitation))
    if cell.data != "thesis":
        return {f"{cell.data}: {name}": value for name, value in found.items() if name in ELSEWHERE}
    if cell.row == EXPERT:
        return found
    train_acted = policies.acted(cell.row, model, world, 100, SCENES + cell.seed)
    for part, acted in (("train", train_acted), ("test", test)):
        found |= dict(zip((f"{part} steps [%]", f"{part} trajs [%]"), thesis_figures(acted), strict=True))
    return (
        found
        | facts
        | _inside(cell.row, model, policies.imitated(), imitation, world)
        | _predicted(cell.row, model, policies)
    )


def many(acted: Acted, world: World) -> dict[str, float]:
    """Trajectories with a contact, those that were lost at the start among all, and the rest of those with one; with
    95% confidence, at most so many of those that are not lost have one."""
    touched = (np.asarray(acted.touching_agent) | np.asarray(acted.touching_obstacle)).any(axis=(1, 2))
    hopeless = lost(acted, world.scene, world.scene)
    if (hopeless & ~touched).any():
        raise RepairError("a scene that was proven to be lost had no contact")
    rest, saved = int((touched & ~hopeless).sum()), int((~hopeless).sum())
    most = clopper_pearson(rest, saved)[1] if saved else math.nan
    values = (touched.sum(), hopeless.sum(), rest, 100 * most, outcome(acted)[DISTANCE])
    return dict(zip(OF_MANY, map(float, values), strict=True))


def certified(model: Model, *, seconds: float) -> dict[str, float]:
    """Shares of the ring around one obstacle, 15 m wide, in which a single agent keeps the barrier."""
    scene = THESIS.world().scene
    barrier = Barrier(kinematics=model.integrator, margin=MUST.margin, share=MUST.share)
    region = Region(obstacle=(0.0, 0.0), depth=15.0, goal=Box.around((40.0, 0.0), (1.0, 1.0)), neighbour=None)
    found = certify(
        model.params, model.scales, Ring(region=region, barrier=barrier, bodies=scene), effort=Work(seconds=seconds)
    )
    shares = (found.proven, found.refuted, found.undecided, found.unavoidable, found.kept)
    values = (*(100 * share for share in shares), found.seconds)
    return {f"{CERTIFIED}: {name}": value for name, value in zip(SHARES, values, strict=True)}


CERTIFYING = 120.0
"""Time of a certificate [s]."""


def _inside(row: str, model: Model, original: Model, imitation: Acted, world: World) -> dict[str, float]:
    """What the policy decides in the states that the imitation policy comes to, in float64."""
    rows, _ = decisions(imitation)
    bodies, kinematics = world.scene, model.integrator
    must = make_constraint(MUST, kinematics)

    def decided(of: Model) -> Float[Array, "R 2"]:
        action = actions(of.params, of.scales, rows)
        if row not in (FILTER, BOTH) or of is not model:
            return action
        kept = make_constraint(SHIELD, kinematics)
        return shielded(kept, rows, executed(rows.own[:, 2:], action, kinematics), bodies, kinematics)

    action, before = decided(model), actions(original.params, original.scales, rows)
    now = screen(must, rows, action, bodies, kinematics)
    was = screen(must, rows, before, bodies, kinematics)
    e = encounters(rows, bodies)
    to_obstacle = replace(e, present=e.present & ~np.asarray(e.steers))
    step = least(Disc(kinematics=kinematics), to_obstacle, executed(rows.own[:, 2:], action, kinematics))
    return {
        ONE_STEP: 100 * float((step < 0).mean()),
        AVOIDABLE: 100 * float(now.avoidable.mean()),
        INTRODUCED: 100 * float((now.violated & ~was.violated).mean()),
    }


def _predicted(row: str, model: Model, policies: Policies) -> dict[str, float]:
    """Errors against what the expert does from the same states; the filter is no network and has none."""
    if row in (FILTER, BOTH):
        return {}
    found = {}
    unseen = recordings(replace(THESIS, scenes=min(250, policies.effort.test_scenes), seed=TEST_SEED), policies.effort)
    for part, truth in (("train", _expert_in_train_scenes(policies)), ("test", unseen)):
        found[f"{part} MSE [m^2]"] = squared(model, truth)
    ten = [published_mean(of.predict, of.params, unseen, window=1, horizon=10) for of in (model, policies.imitated())]
    return found | {DEVIATION: ten[0] / ten[1]}


def _expert_in_train_scenes(policies: Policies) -> Trajectories:
    return recordings(replace(THESIS, scenes=100, seed=SCENES + policies.seed), policies.effort)


def squared(model: Model, truth: Trajectories, *, horizon: int = 10) -> float:
    """Mean squared distance [m^2] of agents from the expert's, predicted `horizon` steps from every tenth row."""
    rows = np.arange(0, truth.position.shape[1] - horizon, 10)
    scene, first = (x.ravel() for x in np.meshgrid(np.arange(len(truth)), rows, indexing="ij"))
    history, future, mask, graph = windows(
        Dataset.of(truth), scene, first, window=1, horizon=horizon, counts=truth.counts
    )
    predicted = np.asarray(model.predict(model.params, history, graph, horizon=horizon))
    agents = truth.counts[2]
    away = np.sum((predicted - np.asarray(future))[..., -agents:, :2] ** 2, axis=-1)
    return float(away[np.asarray(mask)[..., -agents:]].mean())


def draw_6_1(folder: Path, done: Sequence[tuple[Cell, dict]]) -> list[Path]:
    """Contacts against deviation and against the distance to the goal, all rows and seeds."""
    points = [(cell.row, record["values"]) for cell, record in done if cell.data == "thesis" and record["values"]]
    trained = [record for cell, record in done if cell.row not in TABLE_6_1.untrained]
    if not points or not trained:
        return []
    seeds = sorted({cell.seed for cell, _ in done})
    data, effort = f"imitation from {DEMONSTRATIONS} demonstrations", f"{sum(TRAINING.stage_steps)} gradient steps"
    words = small_print(trained[0], data=data, effort=effort, seeds=seeds)
    return write(folder, "table-6.1", pareto(points, TOUCHING, (DEVIATION, AWAY), note=words))


_THESIS = {"imitation": (2.5, 5.0, 4.62, 2.04, 5.2, 4.95), REPLICA: (0.6, 2.0, 20.09, 1.0, 2.8, 19.26)}
ELSEWHERE = (*interval(TOUCHING), BETWEEN, SOLID, EVER, DISTANCE, RATIO, AWAY)
TABLE_6_1 = Experiment(
    name="table-6.1",
    about="collisions before and after repair of the weights by every method, beside a run-time filter",
    rows=ROWS,
    data_sets=(
        DataSet("thesis", MAIN),
        DataSet(MANY, OF_MANY),
        DataSet(CERTIFIED, tuple(f"{CERTIFIED}: {name}" for name in SHARES)),
        *(DataSet(name, tuple(f"{name}: {column}" for column in ELSEWHERE)) for name in OTHERS),
    ),
    run=run_6_1,
    size=lambda cell, effort: learned_from(effort),
    references={
        (row, column): x for row, figures in _THESIS.items() for column, x in zip(THESIS_COLUMNS, figures, strict=True)
    },
    leading=(IMITATED, LOOP),
    untrained=(EXPERT,),
    exists=lambda row, data: (
        data == "thesis"
        or row in (IMITATED, LOOP)
        or (row in (EXPERT, FILTER, BOTH) and data != CERTIFIED)
        or (row == CROWDS and data in OTHERS)
    ),
    unit="as named",
    notes=(
        "Training and repair have their own lengths, whatever the minutes of the profile. "
        f"Networks of preset {TRAINING.model}, imitated from {DEMONSTRATIONS} runs of 1 to 5 agents, 0 to 3 obstacles; "
        "rounds of repair act in such scenes with at least 3 agents and 1 obstacle (`loop in crowds`: with 3 to "
        f"{CROWD} agents), the methods of one step in the thesis's; "
        f"judged in {TESTED} unseen scenes of 5 agents and 1 obstacle, {STEPS} control steps (a quarter of them "
        "elsewhere). "
        "The thesis's columns count obstacles alone, in closed loop, in the test scenes and in 100 train scenes, from "
        "which the methods of one step took their states (ours act in others); it does not say "
        "whether its own are of one step, so decisions that lead into an obstacle in one step, in the states that the "
        "imitation policy comes to, stand beside. MSE: agents' positions, 10 predicted steps against the expert's. "
        "Violations and introduced ones are of the braking barrier by the executed action, in the same states. Rows: "
        "decisions that were constrained, and those that still break their method's own constraint without need. "
        f"The filter keeps the barrier with a margin of {SHIELD.margin:g} m and {SHIELD.share:.3g} of the brakes, as "
        f"the loop learns it, and turns where that is impossible. {MANY[0].upper()}{MANY[1:]}: "
        f"{TIMES} times as many, of another seed; `lost` are those in which two bodies "
        "touch whatever anybody does from the first state on (`repair.lost`); `at most`: Clopper and Pearson, 95%. "
        f"Certificate: `swarmnet certify` for {CERTIFYING:g} s: the ring from the sum of radii to 15 m more, all sides "
        "and velocities, one agent, the goal within 1 m of (40, 0). Contacts are physics'. "
        "low, high: 95% bootstrap over scenes."
    ),
    figure=draw_6_1,
)
