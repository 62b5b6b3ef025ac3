"""The counter-example loop: act in physics, collect what went wrong, distil, polish by quadratic programs, verify.

Every round acts in scenes of its own, so that its contacts are those of unseen scenes; what it finds is learned from
only afterwards. The best round's weights win, by contacts first. That this ends with no contact at all is not promised:
there is no such theorem for loops of this kind.
"""

import json
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import numpy as np
from jaxtyping import Float

from envs.dynamics import Kinematics
from envs.record import Array
from gnn.checkpoint import Model
from gnn.family import Params
from repair.config import LoopConfig
from repair.constraints.constraint import Constraint
from repair.constraints.registry import make_constraint
from repair.descend import Descent, Lessons, Pool
from repair.encounters import Bodies
from repair.errors import RepairError, Status
from repair.filter import safe_actions
from repair.limits import executed
from repair.linearise import FreeWeights, Linearised
from repair.network import Situations, actions, check_encodable, concatenate, fitted
from repair.once import by_branches, by_programs, mendable
from repair.relax import Relaxation, SequentialProblem, relax
from repair.screen import Acted, Perform, Screened, decisions, screen
from repair.verify import Verification, verify
from swarm_mjcf.errors import SwarmError
from swarm_mjcf.whole import WholeFile

Progress = Callable[[int, int, dict], None]
"""`(done, total, what is known)`; total is the number of rounds."""


@dataclass(frozen=True)
class Repaired:
    """What a repair ended with."""

    params: Params
    status: Status
    best: int
    """Round whose weights these are; rounds count policies, 0 is the one that was given."""
    verification: Verification
    """Of the constrained training rows: counter-examples of all rounds."""
    rows: Situations
    """Those rows."""
    seconds: float
    gap: float | None = None
    """Relative gap that the solver of a method of one step left."""
    history: list[dict] = field(default_factory=list)
    """Of every round: contacts of its scenes, violations among its decisions, deviation, seconds."""


class _Work:
    """One repair, as far as it has come; everything in `folder` is whole or absent."""

    def __init__(self, model: Model, config: LoopConfig, bodies: Bodies, perform: Perform, folder: Path | None) -> None:
        self.config, self.bodies, self.perform, self.folder = config, bodies, perform, folder
        self.model, self.normalise = model, check_encodable(model).normalise
        self.kinematics: Kinematics = model.integrator
        self.must = make_constraint(config.constraint, self.kinematics)
        aim = replace(
            config.constraint,
            margin=config.constraint.margin + config.reserve_margin,
            share=config.constraint.share * config.reserve_share,
        )
        self.aim = make_constraint(aim, self.kinematics)
        self.free = FreeWeights.matching(model.params, config.free)
        self.linearised = Linearised(self.free, model.scales, normalise=self.normalise)
        self.origin: Params = jax.device_get(model.params)
        self.pool = Pool(config.pool)
        self.history: list[dict] = []
        self.candidates: list[Params] = []
        self.hard: list[Situations] = []

    def act(self, params: Params, situations: Situations) -> Array:
        return actions(params, self.model.scales, situations, normalise=self.normalise)

    def problem(
        self, constraint: Constraint, constrained: Situations, anchors: Situations, targets: Float[Array, "A 2"]
    ) -> SequentialProblem:
        """A sequential program of this repair."""
        return SequentialProblem(
            scales=self.model.scales,
            normalise=self.normalise,
            constraint=constraint,
            bodies=self.bodies,
            kinematics=self.kinematics,
            constrained=constrained,
            anchors=anchors,
            targets=targets,
        )

    def judged(self, params: Params, number: int) -> tuple[Situations, Screened, dict]:
        """A policy in the scenes of a round, and what its decisions were worth."""
        acted = self.perform(params, number)
        situations, _ = decisions(acted)
        if not len(situations):
            raise RepairError("no agent is present in any scene", round=number)
        action, velocity = self.act(params, situations), situations.own[:, 2:]
        found = screen(self.must, situations, action, self.bodies, self.kinematics)
        before = executed(velocity, self.act(self.origin, situations), self.kinematics)
        change = executed(velocity, action, self.kinematics) - before
        row = {
            "violated": float(found.violated.mean()),
            "avoidable": float(found.avoidable.mean()),
            "changed": float(np.sqrt(np.mean(np.sum(change**2, axis=1)))),
        }
        return situations, found, contacts(acted) | row

    def lessons(self, situations: Situations, params: Params, number: int) -> Lessons:
        """The decisions of a round that are worth learning from: those that the filter would change, those near a body
        and a sample of all. Targets are what the filter makes of the policy's first weights."""
        rng = np.random.default_rng([self.config.seed, number])
        wanted = executed(situations.own[:, 2:], self.act(self.origin, situations), self.kinematics)
        target, possible = safe_actions(self.aim, situations, wanted, self.bodies, self.kinematics)
        now = screen(self.aim, situations, self.act(params, situations), self.bodies, self.kinematics)
        telling = now.violated | (now.slack < NEAR) | (np.sum((target - wanted) ** 2, axis=1) > 1e-4)
        chosen = rng.permutation(np.flatnonzero(telling))[: self.config.lessons]
        if self.config.targets == "own":
            target = wanted
        rows = np.concatenate([chosen, rng.permutation(len(situations))[: self.config.lessons]])
        return Lessons(situations=situations.take(rows), target=target[rows], bound=(possible & now.apart)[rows])

    # ---- on disk ---------------------------------------------------------------------------------------------------

    def save(self, number: int, params: Params, lessons: Lessons, hard: Situations) -> None:
        """What round `number` added and the weights after it."""
        if self.folder is None:
            return
        arrays = {
            f"{kind}/{i}": np.asarray(leaf)
            for kind, tree in (("params", params), ("lessons", lessons), ("hard", hard))
            for i, leaf in enumerate(jax.tree.leaves(tree))
        } | {"row": np.array(json.dumps(self.history[-1]))}
        with WholeFile(self.folder / f"round-{number:02d}.npz") as part:
            np.savez(part, allow_pickle=False, **arrays)

    def load(self, number: int) -> Params | None:
        """Takes up what round `number` left; None where there is nothing whole."""
        path = self.folder / f"round-{number:02d}.npz" if self.folder is not None else None
        if path is None or not path.exists():
            return None
        with _readable(path) as found:

            def tree(kind: str, of: object) -> object:
                count = len(jax.tree.leaves(of))
                return jax.tree.unflatten(jax.tree.structure(of), [found[f"{kind}/{i}"] for i in range(count)])

            self.history.append(json.loads(str(found["row"])))
            lessons, hard = tree("lessons", _LESSONS), tree("hard", _LESSONS.situations)
            assert isinstance(lessons, Lessons)
            assert isinstance(hard, Situations)
            self.pool.add(lessons)
            self.hard.append(hard)
            params = tree("params", self.origin)
            assert isinstance(params, dict)
            return params


@contextmanager
def _readable(path: Path) -> Iterator[Any]:
    try:
        with np.load(path, allow_pickle=False) as found:
            yield found
    except (OSError, ValueError, TypeError, LookupError, EOFError, BadZipFile, zlib.error) as error:
        raise SwarmError(f"{path}: is damaged; remove it and the rounds after it, and the repair goes on") from error


NEAR = 2.0
"""Slack below which a decision counts as near a body, in the constraint's unit."""


def contacts(acted: Acted) -> dict[str, float]:
    """Shares of control steps in which any agent touches, of trajectories, and the final distance to the goal [m]."""
    agent, obstacle = np.asarray(acted.touching_agent), np.asarray(acted.touching_obstacle)
    either = agent | obstacle
    goals, _, agents = acted.graph.counts
    found = {
        "contact_steps": float(either.any(axis=2).mean()),
        "contact_steps_agent": float(agent.any(axis=2).mean()),
        "contact_steps_obstacle": float(obstacle.any(axis=2).mean()),
        "trajectories": float(either.any(axis=(1, 2)).mean()),
        "scenes": len(either),
    }
    if goals:
        last = np.asarray(acted.nodes)[:, -1]
        away = np.linalg.norm(last[:, -agents:, :2] - last[:, :1, :2], axis=-1)
        here = np.asarray(acted.graph.present)[:, -agents:]
        found["goal_distance"] = float(away[here].mean())
    return found


def repair(
    model: Model,
    config: LoopConfig,
    bodies: Bodies,
    perform: Perform,
    *,
    folder: Path | None = None,
    progress: Progress | None = None,
    examples: Situations | None = None,
) -> Repaired:
    """Repairs the weights of `model` that `config.free` names; the model itself is never changed.

    `perform(weights, round)` lets a policy act in physics. `folder`: keeps what each round found, and goes on from
    there when called again with the same settings. `examples`: states to learn from and to constrain besides those that
    it comes to itself, counter-examples of a certificate, say.

    Raises:
      NotEncodable: the network is not one of ReLU layers with inputs linear in the state.
      SpecError: patterns that match nothing, weights that are not finite. RepairError: the descent diverged.
    """
    began = time.perf_counter()
    work = _Work(model, config, bodies, perform, folder)
    descent = None
    if config.method == "distil":
        descent = Descent(
            config.descent, work.free, model.scales, work.aim, bodies, work.kinematics, normalise=work.normalise
        )
    params = work.origin
    tell = progress or (lambda done, total, found: None)
    if config.method in ("thesis", "last-layer"):
        return _once(work, tell, began)
    for number in range(config.rounds + 1):
        work.candidates.append(params)
        kept = work.load(number) if number < config.rounds else None
        if kept is not None:
            params = kept
            began = time.perf_counter() - work.history[-1].get("through", 0.0)  # the seconds of what is done count too
            tell(number + 1, config.rounds + 1, work.history[-1])
            continue
        situations, found, row = work.judged(params, number)
        work.history.append(row | {"round": number, "seconds": time.perf_counter() - began})
        tell(number + 1, config.rounds + 1, work.history[-1])
        if number == config.rounds:
            work.hard.append(situations.take(_worst(found, config.hard)))
            break
        lessons, hard = work.lessons(situations, params, number), situations.take(_worst(found, config.hard))
        if number == 0 and examples is not None:
            more = fitted(examples, situations)
            lessons = _joined(work.lessons(more, params, number), lessons)
            wrong = screen(work.must, more, work.act(params, more), bodies, work.kinematics)
            hard = concatenate([hard, more.take(np.flatnonzero(wrong.avoidable))])
        work.pool.add(lessons)
        work.hard.append(hard)
        within = partial(_within, tell, number + 1, config.rounds + 1, work.history[-1])
        if descent is not None:
            params, seen = descent(params, work.pool, seed=config.seed + number, progress=within)
        else:
            params, seen = _programmed(work, params, number, within)
        work.history[-1] |= seen | {"through": time.perf_counter() - began}
        work.save(number, params, lessons, hard)
    best = min(range(len(work.candidates)), key=lambda i: _score(work.history[i]))
    rows = concatenate(work.hard)
    params = work.candidates[best]
    if (polished := _polish(work, params, rows, tell)) is not None:
        _, _, row = work.judged(polished, config.rounds + 1)
        work.history.append(row | {"round": config.rounds + 1, "polished": True})
        # Few contacts are noise: rows that hold count for more, as long as contacts stay of the same order.
        if row["contact_steps"] <= 2 * work.history[best]["contact_steps"] + 1e-3:
            params, best = polished, config.rounds + 1
    verification = verify(
        params, model.scales, rows, work.must, bodies, work.kinematics, normalise=work.normalise, before=work.origin,
        possible=True,
    )  # fmt: skip
    status = Status.FEASIBLE if verification.holds_as_executed else Status.ELASTIC
    return Repaired(params, status, best, verification, rows, time.perf_counter() - began, None, work.history)


def _once(work: _Work, tell: Progress, began: float) -> Repaired:
    """A method that takes its states from round 0 and solves one program."""
    config, model = work.config, work.model
    situations, _, row = work.judged(work.origin, 0)
    work.history.append(row | {"round": 0, "seconds": time.perf_counter() - began})
    tell(1, 2, work.history[-1])
    rng = np.random.default_rng(config.seed)
    agents = max(1, round(len(situations) / (config.scenes * config.steps)))
    chosen = np.sort(rng.permutation(len(situations))[: config.states * agents])
    rows = mendable(model, work.normalise, work.must, situations.take(chosen), work.bodies)
    method = by_programs if config.method == "thesis" else by_branches
    params, gap, ended = method(model, work.normalise, config, work.must, rows, work.bodies)
    seconds = time.perf_counter() - began
    _, _, row = work.judged(params, 1)
    work.history.append(row | {"round": 1, "seconds": time.perf_counter() - began})
    tell(2, 2, work.history[-1])
    found = verify(
        params, model.scales, rows, work.must, work.bodies, work.kinematics, normalise=work.normalise,
        before=work.origin, possible=True,
    )  # fmt: skip
    status = ended if not ended.solved else Status.FEASIBLE if found.holds_as_executed else Status.ELASTIC
    return Repaired(params, status, 1, found, rows, seconds, gap, work.history)


def _within(tell: Progress, number: int, rounds: int, row: dict, done: int, total: int, seen: dict) -> None:
    tell(number, rounds, row | seen | {"descent": done / total})


def _joined(one: Lessons, other: Lessons) -> Lessons:
    return jax.tree.map(lambda *xs: np.concatenate(xs), one, other)


def _score(row: dict) -> tuple[float, float]:
    return row["contact_steps"], row["avoidable"]


def _worst(found: Screened, most: int) -> np.ndarray:
    rows = np.flatnonzero(found.avoidable)
    return rows[np.argsort(found.slack[rows], kind="stable")[:most]]


def _programmed(work: _Work, params: Params, number: int, within: Callable) -> tuple[Params, dict]:
    """A round by quadratic programs: of the pool, what breaks the aim is constrained, a sample is held on to."""
    rng = np.random.default_rng([work.config.seed, number, 1])
    lessons = _doubles(work.pool)
    now = screen(work.aim, lessons.situations, work.act(params, lessons.situations), work.bodies, work.kinematics)
    broken = np.flatnonzero(now.violated & lessons.bound)
    # A sample: the worst alone pull weights as few as these where nothing holds any more.
    constrained = rng.permutation(broken)[: work.config.hard]
    anchors = rng.permutation(len(lessons))[: work.config.anchors]
    problem = work.problem(
        work.aim, lessons.situations.take(constrained), lessons.situations.take(anchors), lessons.target[anchors]
    )
    found = relax(
        problem,
        params,
        work.free,
        Relaxation(price=work.config.price),
        origin=work.origin,
        linearised=work.linearised,
        progress=within,
    )
    return found.params, {"left": found.violated, "steps": len(found.history)}


def _doubles(pool: Pool) -> Lessons:
    """What is in the pool, in float64."""
    assert pool.lessons is not None
    return jax.tree.map(
        lambda x: x[: pool.count] if x.dtype == bool else x[: pool.count].astype(np.float64), pool.lessons
    )


def _polish(work: _Work, params: Params, rows: Situations, tell: Progress) -> Params | None:
    """Quadratic programs for counter-examples that still break the constraint; None where there are none."""
    config = work.config
    now = screen(work.must, rows, work.act(params, rows), work.bodies, work.kinematics)
    if not now.violated.any() or not config.polish or not work.pool.count:
        return None
    lessons = _doubles(work.pool)
    anchors = lessons.situations.take(np.random.default_rng(config.seed).permutation(len(lessons))[: config.anchors])
    # All rows can be mended, or they would not be here; what was learned so far should stay.
    problem = work.problem(work.must, rows, anchors, work.act(params, anchors))
    free = FreeWeights.matching(params, config.polish)
    total = config.rounds + 1

    def report(done: int, most: int, seen: dict) -> None:
        tell(total, total, work.history[-1] | seen | {"polish": done / most})

    found = relax(problem, params, free, Relaxation(price=config.price), progress=report)
    return found.params


_KINDS = ("agent", "goal", "obstacle")
_LESSONS = Lessons(
    situations=Situations(
        own=np.zeros((0, 4)),
        senders=dict.fromkeys(_KINDS, np.zeros((0, 0, 4))),
        present=dict.fromkeys(_KINDS, np.zeros((0, 0), bool)),
    ),
    target=np.zeros((0, 2)),
    bound=np.zeros(0, bool),
)
"""The structure of what a round keeps; shapes do not matter."""
