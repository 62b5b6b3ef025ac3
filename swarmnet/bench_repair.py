"""What repair can prove and what its parts cost: seconds to a proven gap against rows, box and margin; one core."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np

from envs.simulate import simulate_in_memory
from gnn.checkpoint import Model, load_model
from gnn.train import split, train
from repair.branch import branch_readout
from repair.config import DescentConfig, LoopConfig
from repair.constraints.barrier import Barrier
from repair.constraints.constraint import Constraint
from repair.constraints.diamond import Diamond
from repair.constraints.disc import Disc
from repair.descend import Descent, Lessons, Pool
from repair.encode import encode
from repair.encounters import Bodies, encounters
from repair.layerwise import layerwise
from repair.linearise import FreeWeights, Linearised
from repair.network import Situations, actions, check_encodable, concatenate
from repair.problem import Problem
from repair.relax import Relaxation, SequentialProblem, relax
from repair.screen import decisions, screen
from repair.solve import Limits, solve
from repair.verify import verify
from repair.weight_box import polish
from swarmnet.acting import make_perform
from swarmnet.progress import Update
from swarmnet.reproduce.table_6_1 import LEARNED, THESIS, TRAINING
from swarmnet.reproduce.work import VALIDATION

GAP = 0.01
"""Proven when the relative gap is at most that."""
EDGE = "edge/obstacle/layer2"
MARGINS, ROWS = (0.0, 0.1, 0.5), (500, 1000, 2000, 5000)
EDGE_BOXES, EDGE_ROWS = (0.005, 0.01, 0.02, 0.05), (5, 10, 20, 40)
THESIS_BOXES, THESIS_ROWS = (0.1, 0.3, 1.0), (500, 5000)
"""Boxes: how far a weight may go. Rows: agents that decide; 5000 are those of the thesis's 1000 states."""
ROTATION_BOX, ROTATION_ROWS, TURNS = 0.02, (10, 20, 40), 4
"""The rotation over layers: rows, of which half break the barrier, and rounds at most."""
SCENES, STEPS, SEED = 512, 50, 3_000_000
"""Of roll-outs."""
PRICE = 1.0
"""Of a violation in the thesis's program, per m/s^2."""


@dataclass(frozen=True, kw_only=True)
class Proof:
    """One program and how far it was proven."""

    family: str
    rows: int
    setting: str
    """`margin` [m] or `box`."""
    value: float
    seconds: float
    """Until the gap was proven or time was up."""
    gap: float
    """(incumbent - bound) / incumbent; infinite without an incumbent."""
    status: str
    binaries: int = 0
    size: tuple[int, int] | None = None
    """Rows and columns of a mixed-integer program."""
    incumbent: float = np.inf
    bound: float = 0.0
    left: int = 0
    """Rows that still break the constraint without need, by the check that knows no solver."""

    @property
    def proven(self) -> bool:
        """Whether the gap is at most `GAP`."""
        return self.gap <= GAP * (1 + 1e-9)


@dataclass(frozen=True)
class Part:
    """Seconds of a part of the counter-example loop, once compiled."""

    name: str
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Rotation:
    """A rotation of mixed-integer programs over layers (`repair.layerwise`)."""

    layers: str
    rows: int
    box: float
    seconds: float
    before: float
    """Merit of the network's own weights."""
    after: float
    steps: int
    """Programs that were solved."""
    accepted: int
    """Those that lowered the merit."""
    broken: int
    """Rows that broke the constraint without need."""
    left: int
    """Those that do afterwards."""


@dataclass(frozen=True)
class Study:
    """A network and decisions of its own."""

    model: Model
    situations: Situations
    bodies: Bodies

    def acts(self, situations: Situations) -> np.ndarray:
        """The network's actions [m/s^2]."""
        return np.asarray(actions(self.model.params, self.model.scales, situations))

    def drawn(self, constraint: Constraint, count: int, *, broken: bool | None = None) -> Situations:
        """Decisions in an order that is the same for every count, without those that break the constraint and could
        not but do so; `broken`: only those that break it without need, or that keep it."""
        found = screen(constraint, self.situations, self.acts(self.situations), self.bodies, self.model.integrator)
        wanted = found.avoidable if broken else ~found.violated
        if broken is None:
            wanted |= found.avoidable
        order = np.random.default_rng(0).permutation(len(wanted))
        return self.situations.take(order[wanted[order]][:count])

    def left(self, params: dict, situations: Situations, constraint: Constraint) -> int:
        """Rows whose executed action breaks the constraint without need."""
        found = verify(params, self.model.scales, situations, constraint, self.bodies, self.model.integrator)
        return found.avoidable


def network(run: Path | None, seed: int, scenes: int, folder: Path, progress: Update) -> Model:
    """The network of a run folder, or one imitated as those of table 6.1, from `scenes` demonstrations."""
    if run is not None:
        model = load_model(run / "checkpoints")
    else:
        recorded = simulate_in_memory(replace(LEARNED, scenes=scenes, seed=seed))
        learning, validation = split(recorded, VALIDATION)

        def report(done: int, total: int, row: dict) -> None:
            progress(done, total, f"loss {row['loss']:.3g}" if "loss" in row else "")

        model = train(replace(TRAINING, seed=seed), learning, folder, validation=validation, progress=report)
    check_encodable(model)
    return model


def bench_repair(model: Model, seconds: float) -> Iterator[Proof | Part | Rotation | str]:
    """Everything, in the thesis's scenes. `seconds` limits each program of edge functions, a quarter of it those of the
    last layer, a tenth each of those that rotate."""
    world = THESIS.world()
    perform = make_perform(model, world, scenes=SCENES, steps=STEPS, seed=SEED)
    acted = perform(model.params, 0)
    situations, _ = decisions(acted)
    study = Study(model, situations, world.scene)
    begun = time.perf_counter()
    perform(model.params, 1)
    yield Part("roll-out", time.perf_counter() - begun)
    yield from loop_parts(study)
    yield from last_layer(study, seconds / 4)
    yield from thesis(study, seconds / 4)
    yield from edge_function(study, seconds)
    yield from rotations(study, seconds / 10)


def last_layer(
    study: Study, seconds: float, *, rows: tuple[int, ...] = ROWS, margins: tuple[float, ...] = MARGINS
) -> Iterator[Proof]:
    """The readout free, true discs, hard; of obstacles alone, as in the thesis, and of agents too."""
    model = study.model
    for agents, margin, count in ((a, m, n) for a in (False, True) for m in margins for n in rows):
        disc = Disc(kinematics=model.integrator, margin=margin)
        drawn = study.drawn(disc, count)
        e = encounters(drawn, study.bodies)
        e = e if agents else replace(e, present=e.present & ~np.asarray(e.steers))
        found = branch_readout(model.params, model.scales, drawn, drawn, e, disc, gap=GAP, seconds=seconds)
        yield Proof(
            family="last layer, obstacles and agents" if agents else "last layer, obstacles",
            rows=len(drawn), setting="margin", value=margin, seconds=found.seconds, gap=found.gap, status=found.status,
            incumbent=found.incumbent, bound=found.bound,
        )  # fmt: skip


def edge_function(
    study: Study, seconds: float, *, rows: tuple[int, ...] = EDGE_ROWS, boxes: tuple[float, ...] = EDGE_BOXES
) -> Iterator[Proof | str]:
    """The obstacle's edge function's last layer free, around what sequential programs find for counter-examples."""
    model, barrier = study.model, Barrier(kinematics=study.model.integrator)
    free = FreeWeights.matching(model.params, [f"{EDGE}/*"])
    linearised = Linearised(free, model.scales, normalise=True)
    hopeless = np.inf
    for count in rows:
        drawn = study.drawn(barrier, count, broken=True)
        targets = study.acts(drawn)
        sequence = SequentialProblem(
            scales=model.scales, normalise=True, constraint=barrier, bodies=study.bodies, kinematics=model.integrator,
            constrained=drawn, anchors=drawn, targets=targets,
        )  # fmt: skip
        settings = Relaxation(stiffness=1e-6, price=100.0)
        centre = relax(sequence, jax.device_get(model.params), free, settings, linearised=linearised)
        problem = Problem(
            scales=model.scales, situations=drawn, targets=targets, constraint=barrier, bodies=study.bodies,
            limit=model.integrator.max_acceleration,
        )  # fmt: skip
        for box in boxes:
            if box >= hopeless:
                yield f"edge function: box {box:g} is left out from {count} rows on, fewer were not proven in time"
                continue
            found = polish(centre.params, problem, free=EDGE, radius=box, limits=Limits(seconds=seconds, gap=GAP))
            gap = np.inf if found.gap is None else found.gap
            yield Proof(
                family="edge function", rows=len(drawn), setting="box", value=box, seconds=found.seconds, gap=gap,
                status=found.status, binaries=found.size["binaries"], size=_size(found.size),
                incumbent=np.inf if found.incumbent is None else found.incumbent, bound=found.bound or 0.0,
                left=study.left(found.params, drawn, barrier),
            )  # fmt: skip
            if gap > GAP:
                hopeless = min(hopeless, box)


def thesis(
    study: Study, seconds: float, *, rows: tuple[int, ...] = THESIS_ROWS, boxes: tuple[float, ...] = THESIS_BOXES
) -> Iterator[Proof]:
    """Chapter 6's program: the readout free, L1 diamonds around obstacles, violations at a price, started from the
    network's own weights, so that there always is an incumbent."""
    model, diamond = study.model, Diamond(kinematics=study.model.integrator)
    for count, box in ((n, b) for n in rows for b in boxes):
        drawn = study.drawn(diamond, count)
        problem = Problem(
            scales=model.scales, situations=drawn, targets=study.acts(drawn), constraint=diamond, bodies=study.bodies,
            agents=False, price=PRICE,
        )  # fmt: skip
        begun = time.perf_counter()
        encoded = encode(model.params, problem, free="readout/layer0", radius=box)
        left, start = max(seconds - (time.perf_counter() - begun), 0.0), encoded.values_of(model.params)
        found = solve(encoded.program, solver="highspy", limits=Limits(seconds=left, gap=GAP), start=start)
        params = model.params if found.values is None else encoded.params_of(found.values)
        yield Proof(
            family="thesis", rows=len(drawn), setting="box", value=box, seconds=time.perf_counter() - begun,
            gap=np.inf if found.gap is None else found.gap, status=found.status,
            binaries=encoded.program.size["binaries"], size=_size(encoded.program.size),
            incumbent=np.inf if found.incumbent is None else found.incumbent, bound=found.bound or 0.0,
            left=study.left(params, drawn, diamond),
        )  # fmt: skip


def rotations(study: Study, seconds: float, *, rows: tuple[int, ...] = ROTATION_ROWS) -> Iterator[Rotation]:
    """The thesis's rotation, for the barrier: over every layer, and over the readout alone, which may go as far.

    `seconds` limits each program.
    """
    model, barrier = study.model, Barrier(kinematics=study.model.integrator)
    for count in rows:
        half = count // 2
        drawn = concatenate([study.drawn(barrier, half, broken=True), study.drawn(barrier, count - half, broken=False)])
        problem = Problem(
            scales=model.scales, situations=drawn, targets=study.acts(drawn), constraint=barrier, bodies=study.bodies,
            limit=model.integrator.max_acceleration,
        )  # fmt: skip
        own = jax.device_get(model.params)
        for name, layers in (("readout alone", ["readout/layer0"]), ("all layers", None)):
            begun = time.perf_counter()
            found = layerwise(
                own, problem, radius=ROTATION_BOX, price=PRICE, layers=layers, rounds=TURNS,
                limits=Limits(seconds=seconds, gap=GAP),
            )  # fmt: skip
            yield Rotation(
                layers=name, rows=len(drawn), box=ROTATION_BOX, seconds=time.perf_counter() - begun,
                before=found.history[0].before, after=found.merit, steps=len(found.history),
                accepted=sum(step.accepted for step in found.history), broken=study.left(own, drawn, barrier),
                left=study.left(found.params, drawn, barrier),
            )  # fmt: skip


def _size(size: dict[str, int]) -> tuple[int, int]:
    return size["rows"], size["columns"]


def loop_parts(study: Study, *, steps: int = DescentConfig().steps) -> Iterator[Part]:
    """Screening all decisions; Adam's steps of a round; one quadratic program of the round's counter-examples."""
    model, how = study.model, LoopConfig()
    barrier = Barrier(kinematics=model.integrator)
    begun = time.perf_counter()
    found = screen(barrier, study.situations, study.acts(study.situations), study.bodies, model.integrator)
    yield Part("screening", time.perf_counter() - begun)

    rows = np.random.default_rng(0).permutation(len(study.situations))[: 2 * how.lessons]
    lessons = study.situations.take(rows)
    pool = Pool(2 * how.lessons)
    targets = study.acts(lessons)
    pool.add(Lessons(situations=lessons, target=targets, bound=(found.possible & found.apart)[rows]))
    free = FreeWeights.matching(model.params, how.free)
    descent = Descent(
        replace(how.descent, steps=steps), free, model.scales, barrier, study.bodies, model.integrator, normalise=True
    )
    descent(model.params, pool, seed=0)  # compiles
    begun = time.perf_counter()
    descent(model.params, pool, seed=0)
    yield Part(f"{steps} Adam steps", time.perf_counter() - begun)

    free = FreeWeights.matching(model.params, how.polish)
    linearised = Linearised(free, model.scales, normalise=True)
    broken = study.situations.take(np.flatnonzero(found.avoidable)[: how.hard])
    anchors = study.situations.take(rows[: how.anchors])
    sequence = SequentialProblem(
        scales=model.scales, normalise=True, constraint=barrier, bodies=study.bodies, kinematics=model.integrator,
        constrained=broken, anchors=anchors, targets=study.acts(anchors),
    )  # fmt: skip
    params, once = jax.device_get(model.params), Relaxation(price=how.price, steps=1)
    relax(sequence, params, free, once, linearised=linearised)  # compiles
    begun = time.perf_counter()
    relax(sequence, params, free, once, linearised=linearised)
    yield Part("quadratic program", time.perf_counter() - begun)
