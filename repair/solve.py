"""Emits a program to a solver, and believes nothing that it says before the values are put into the program's rows."""

import contextlib
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

import cvxpy as cp
import highspy
import numpy as np
from jaxtyping import Float

from repair.errors import RepairError, SolverMissing, Status
from repair.program import SLACK, Program
from swarm_mjcf.errors import SpecError

Solver = Literal["HIGHS", "SCIP", "GUROBI", "highspy"]
"""The first three through cvxpy; `highspy` is HiGHS directly, which takes a start."""
TOLERANCE = 1e-6
"""Largest violation of a row, a bound or integrality that counts as none, relative to the row's magnitude."""
_FEASIBILITY = 1e-7
"""What solvers are asked for: stricter than what is checked."""
_INFINITE = 1e20
"""Where SCIP's infinity begins."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """When a solver gives up, and what makes two runs alike."""

    seconds: float = 60.0
    """Wall time [s]; infinite for none. Solvers overshoot it by seconds on large programs."""
    nodes: int | None = None
    """Nodes of branch and bound."""
    gap: float = 1e-4
    """Relative gap between incumbent and bound that counts as optimal."""
    threads: int = 1
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.seconds >= 0:
            raise SpecError("seconds", self.seconds, "at least 0")
        if self.nodes is not None and self.nodes < 0:
            raise SpecError("nodes", self.nodes, "at least 0, or None")
        if not self.gap >= 0:
            raise SpecError("gap", self.gap, "at least 0")
        if self.threads < 1:
            raise SpecError("threads", self.threads, "at least 1")


@dataclass(frozen=True, kw_only=True)
class Solution:
    """How a program was solved; values that do not satisfy its rows are never among it."""

    status: Status
    values: Float[np.ndarray, " n"] | None
    incumbent: float | None
    """Cost of the values, recomputed."""
    bound: float | None
    """No solution costs less, says the solver."""
    gap: float | None
    """(incumbent - bound) / |incumbent|."""
    seconds: float
    nodes: int
    solver: str
    said: str
    """The solver's own word for how it ended."""


@dataclass(frozen=True)
class _Answer:
    """What a solver said, in common terms."""

    ended: Literal["optimal", "infeasible", "unbounded", "either", "limit", "failed"]
    said: str
    values: np.ndarray | None = None
    bound: float | None = None
    nodes: int = 0


def solve(
    program: Program,
    *,
    solver: Solver = "HIGHS",
    limits: Limits | None = None,
    start: Float[np.ndarray, " n"] | None = None,
) -> Solution:
    """Solves a program; returned values are checked against its rows, bounds and integrality (`TOLERANCE`).

    `start` holds values of the integer columns to begin with (others are ignored), for solver `highspy` alone.
    Raises SolverMissing, naming what is installed; RepairError for a program without a least cost (unbounded).
    """
    limits = limits or Limits()
    emit = _emitter(solver, start)
    begun = time.perf_counter()
    if _contradictory(program):
        answer = _Answer("infeasible", "contradictory bounds")
    else:
        answer = emit(program, limits)
        if answer.ended == "either":
            free = replace(program, cost=np.zeros_like(program.cost))
            again = emit(free, limits)
            answer = again if again.ended in ("infeasible", "limit", "failed") else _Answer("unbounded", answer.said)
    seconds = time.perf_counter() - begun
    if answer.ended == "unbounded":
        evidence: dict[str, Any] = {"solver": solver, "said": answer.said, **program.size}
        raise RepairError("the program has no least cost", **evidence)
    status, values = _judged(program, answer)
    incumbent = None if values is None else program.objective(values)
    bound = answer.bound if answer.bound is not None and abs(answer.bound) < _INFINITE else None
    bound = None if status == Status.INFEASIBLE else bound
    return Solution(
        status=status,
        values=values,
        incumbent=incumbent,
        bound=bound,
        gap=None if incumbent is None or bound is None else max(0.0, incumbent - bound) / max(abs(incumbent), 1e-9),
        seconds=seconds,
        nodes=answer.nodes,
        solver=solver,
        said=answer.said,
    )


def installed() -> list[str]:
    """Mixed-integer solvers that are here."""
    return [name for name in ("HIGHS", "SCIP", "GUROBI") if name in cp.installed_solvers()] + ["highspy"]


def _emitter(solver: str, start: np.ndarray | None) -> Callable[[Program, Limits], _Answer]:
    if solver not in installed():
        extra = {"SCIP": "pyscipopt", "GUROBI": "gurobipy"}.get(solver)
        how = f"; install {extra}" if extra else ""
        raise SolverMissing(f"solver {solver} is not installed, {', '.join(installed())} are{how}")
    if solver == "highspy":
        return lambda program, limits: _highspy(program, limits, start)
    if start is not None:
        raise SpecError("start", "a start", f"None with {solver}: cvxpy passes none on; use highspy")
    return lambda program, limits: _cvxpy(program, limits, solver)


def _contradictory(program: Program) -> bool:
    """Whether bounds or rows rule out everything by themselves; not every solver looks at rows that nothing is in."""
    empty = _empty(program)
    return bool(
        (program.lower > program.upper).any()
        or (program.low > program.high).any()
        or (program.low[empty] > 0).any()
        or (program.high[empty] < 0).any()
    )


def _empty(program: Program) -> np.ndarray:
    return np.diff(program.matrix.indptr) == 0


def _judged(program: Program, answer: _Answer) -> tuple[Status, np.ndarray | None]:
    """The status by what the values do, not by what the solver says of them."""
    if answer.ended == "infeasible":
        return Status.INFEASIBLE, None
    if answer.values is None:
        return (Status.NO_INCUMBENT if answer.ended == "limit" else Status.NUMERICAL), None
    values = np.clip(answer.values, program.lower, program.upper)  # what the solver's tolerance left outside
    if np.abs(values - answer.values).max(initial=0) > TOLERANCE * (1 + np.abs(values).max(initial=0)):
        return Status.NUMERICAL, None
    if not program.excess(values) <= TOLERANCE:
        return Status.NUMERICAL, None
    slack = values[program.blocks[SLACK].ravel()] if SLACK in program.blocks else np.zeros(0)
    if (slack > TOLERANCE).any():
        return Status.ELASTIC, values
    return (Status.OPTIMAL if answer.ended == "optimal" else Status.FEASIBLE), values


def highs_of(program: Program, *, relaxed: bool = False) -> highspy.Highs:
    """HiGHS with the program in it, silent; `relaxed` forgets integrality."""
    matrix = program.matrix.tocsc()
    lp: Any = highspy.HighsLp()
    lp.num_row_, lp.num_col_ = len(program.low), len(program.cost)
    lp.col_cost_, lp.col_lower_, lp.col_upper_ = program.cost, program.lower, program.upper
    lp.row_lower_, lp.row_upper_ = program.low, program.high
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_, lp.a_matrix_.index_, lp.a_matrix_.value_ = matrix.indptr, matrix.indices, matrix.data
    if program.integer.any() and not relaxed:
        kinds = (highspy.HighsVarType.kContinuous, highspy.HighsVarType.kInteger)
        lp.integrality_ = [kinds[whole] for whole in program.integer.astype(int)]
    highs = highspy.Highs()
    highs.setOptionValue("output_flag", False)
    if highs.passModel(lp) == highspy.HighsStatus.kError:
        evidence: dict[str, Any] = dict(program.size)
        raise RepairError("HiGHS does not take the program", **evidence)
    return highs


def _highs_options(limits: Limits) -> dict[str, Any]:
    nodes = {} if limits.nodes is None else {"mip_max_nodes": limits.nodes}
    return nodes | {
        "time_limit": float(limits.seconds),
        "mip_rel_gap": float(limits.gap),
        "threads": limits.threads,
        "random_seed": limits.seed,
        "primal_feasibility_tolerance": _FEASIBILITY,
        "mip_feasibility_tolerance": _FEASIBILITY,
    }


_HIGHS_ENDS: dict[str, Any] = {
    "kOptimal": "optimal",
    "kModelEmpty": "optimal",
    "kInfeasible": "infeasible",
    "kUnbounded": "unbounded",
    "kUnboundedOrInfeasible": "either",
    "kTimeLimit": "limit",
    "kIterationLimit": "limit",
    "kSolutionLimit": "limit",
    "kObjectiveBound": "limit",
    "kObjectiveTarget": "limit",
    "kInterrupt": "limit",
}


def _highspy(program: Program, limits: Limits, start: np.ndarray | None) -> _Answer:
    highs = highs_of(program)
    highspy.Highs.resetGlobalScheduler(True)  # it keeps the number of threads of whoever came first
    for name, value in _highs_options(limits).items():
        highs.setOptionValue(name, value)
    if start is not None and program.integer.any():
        whole = np.flatnonzero(program.integer).astype(np.int32)
        highs.setSolution(len(whole), whole, np.round(start[whole]).astype(float))
    highs.run()
    info, said = highs.getInfo(), highs.getModelStatus().name
    found = info.primal_solution_status == highspy.SolutionStatus.kSolutionStatusFeasible
    values = np.array(highs.getSolution().col_value) if found else None
    if said == "kModelEmpty":
        values = program.lower.copy()
    return _of_highs(program, said, info, values)


def _of_highs(program: Program, said: str, info: Any, values: np.ndarray | None) -> _Answer:
    ended = _HIGHS_ENDS.get(said, "failed")
    if program.integer.any():
        bound, nodes = float(info.mip_dual_bound), max(0, int(info.mip_node_count))
    else:
        bound, nodes = (float(info.objective_function_value) if ended == "optimal" else None), 0
    return _Answer(ended, said.removeprefix("k"), values, bound, nodes)


def _cvxpy(program: Program, limits: Limits, solver: str) -> _Answer:
    x = cp.Variable(
        len(program.cost),
        integer=(np.flatnonzero(program.integer),) if program.integer.any() else False,
        bounds=[program.lower, program.upper],
    )
    filled = ~_empty(program)
    equal = filled & (program.low == program.high)
    below = filled & ~equal & np.isfinite(program.high)
    above = filled & ~equal & np.isfinite(program.low)
    rows = program.matrix
    constraints = [
        *([rows[equal] @ x == program.low[equal]] if equal.any() else []),
        *([rows[below] @ x <= program.high[below]] if below.any() else []),
        *([rows[above] @ x >= program.low[above]] if above.any() else []),
    ]
    problem = cp.Problem(cp.Minimize(program.cost @ x), constraints)
    options = _options(solver, limits)
    raw: Any = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of inaccurate solutions: all are checked
        data, chain, inverse = problem.get_problem_data(solver)
        assert chain is not None
        raw = chain.solve_via_data(problem, data, solver_opts=options)
        with contextlib.suppress(cp.SolverError, KeyError):  # a limit without an incumbent, of SCIP
            problem.unpack_results(raw, chain, inverse)
    values = None if x.value is None else np.asarray(x.value, float)
    if solver == "HIGHS":
        feasible = raw["info"].primal_solution_status == highspy.SolutionStatus.kSolutionStatusFeasible
        # Without an incumbent, cvxpy returns zeros.
        return _of_highs(program, raw["model_status"], raw["info"], values if feasible else None)
    if solver == "SCIP":
        model, said = raw["model"], raw["scip_status"]
        ends: dict[str, Any] = {"optimal": "optimal", "infeasible": "infeasible", "unbounded": "unbounded"}
        ends |= {"inforunbd": "either", "gaplimit": "optimal"}
        ended = ends.get(said, "limit" if said.endswith("limit") else "failed")
        values = values if model.getNSols() else None
        return _Answer(ended, said, values, float(model.getDualbound()), int(model.getNNodes()))
    return _of_gurobi(program, raw["model"], values)


_GUROBI_ENDS: dict[int, tuple[Any, str]] = {
    2: ("optimal", "OPTIMAL"),
    3: ("infeasible", "INFEASIBLE"),
    4: ("either", "INF_OR_UNBD"),
    5: ("unbounded", "UNBOUNDED"),
    7: ("limit", "ITERATION_LIMIT"),
    8: ("limit", "NODE_LIMIT"),
    9: ("limit", "TIME_LIMIT"),
    10: ("limit", "SOLUTION_LIMIT"),
    11: ("limit", "INTERRUPTED"),
    16: ("limit", "WORK_LIMIT"),
    17: ("limit", "MEM_LIMIT"),
}
"""By `Model.Status`: a limit without an incumbent is "infeasible_inaccurate" in cvxpy's words."""


def _of_gurobi(program: Program, model: Any, values: np.ndarray | None) -> _Answer:
    if model.Status == 1:  # only loaded: why, cvxpy has swallowed
        try:
            model.optimize()
        except Exception as error:
            evidence: dict[str, Any] = dict(program.size)
            raise RepairError(f"Gurobi does not take the program ({error})", **evidence) from error
    ended, said = _GUROBI_ENDS.get(model.Status, ("failed", f"status {model.Status}"))
    return _Answer(ended, said, values if model.SolCount else None, float(model.ObjBound), int(model.NodeCount))


def _options(solver: str, limits: Limits) -> dict[str, Any]:
    """Limits in a solver's own words. SCIP and Gurobi count an infinite time as theirs."""
    seconds = min(limits.seconds, 1e9)
    if solver == "HIGHS":
        highspy.Highs.resetGlobalScheduler(True)
        return {"highs_options": _highs_options(limits)}
    if solver == "SCIP":
        params = {
            "limits/time": seconds,
            "limits/gap": limits.gap,
            "randomization/randomseedshift": limits.seed,
            "parallel/maxnthreads": limits.threads,
            "lp/threads": limits.threads,
            "numerics/feastol": _FEASIBILITY,
        }
        return {"scip_params": params | ({} if limits.nodes is None else {"limits/nodes": limits.nodes})}
    params = {"TimeLimit": seconds, "MIPGap": limits.gap, "Threads": limits.threads, "Seed": limits.seed}
    params |= {"FeasibilityTol": _FEASIBILITY, "IntFeasTol": _FEASIBILITY}
    return params | ({} if limits.nodes is None else {"NodeLimit": limits.nodes})
