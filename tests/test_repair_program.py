"""Programs as data, and solvers that are not believed."""

import types
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from scipy import sparse

from repair.errors import RepairError, SolverMissing, Status, Unbounded
from repair.program import SLACK, Builder, Linear, Program, columns, constant, each
from repair.solve import Limits, Solver, _of_gurobi, installed, solve
from swarm_mjcf.errors import SpecError

SOLVERS = tuple(solver for solver in get_args(Solver) if solver != "GUROBI" or solver in installed())
"""Gurobi where it is installed: its wheel comes with a licence for programs as small as these."""


def knapsack(values, weights, room: float) -> Program:
    """The best load: minimise -values."""
    build = Builder()
    take = build.variables("take", (len(values),), integer=True)
    build.rows(columns(take).map(sparse.csr_array(np.array([weights]))), high=room)
    return replace(build.program(), cost=-np.asarray(values, float))


def hard(seed: int = 0, size: int = 40) -> Program:
    """A market split: equalities that no small search satisfies."""
    rng = np.random.default_rng(seed)
    matrix = rng.integers(0, 100, (5, size))
    build = Builder()
    take = build.variables("take", (size,), integer=True)
    build.rows(columns(take).map(sparse.csr_array(matrix.astype(float))), *(2 * [matrix.sum(axis=1) // 2 + 0.0]))
    return build.program()


def test_expressions():
    build = Builder()
    x = build.variables("x", (2, 3), lower=-1.0, upper=1.0)
    y = build.variables("y", (2,), lower=np.array([0.0, 2.0]), upper=5.0)
    kernel = np.arange(6.0).reshape(3, 2)
    expression = columns(x).map(each(2, kernel.T), np.ones(4)) - columns(np.repeat(y, 2)).times(2.0)
    at = np.random.default_rng(0).normal(size=8)
    expected = at[:6].reshape(2, 3) @ kernel + 1 - 2 * at[6:, None]
    np.testing.assert_allclose(expression.at(at), expected.ravel())
    np.testing.assert_allclose(expression.take(np.array([2])).at(at), expected[1, :1])
    build.rows(expression, low=1.0, high=3.0)
    program = build.program()
    assert program.size == {"rows": 4, "columns": 8, "binaries": 0, "coefficients": 2 * (6 - 1) + 4}
    np.testing.assert_allclose(program.low, [0, 0, 0, 0])
    np.testing.assert_allclose(program.lower[6:], [0, 2])
    assert program.blocks["x"].shape == (2, 3)
    with pytest.raises(ValueError, match="exists"):
        build.variables("x", (1,))


@pytest.mark.parametrize("big", [np.inf, np.nan])
def test_an_infinite_big_m_is_refused(big):
    build = Builder()
    x = build.variables("x", (1,))
    with pytest.raises(Unbounded):
        build.rows(columns(x).times(big), high=0.0)
    with pytest.raises(Unbounded):
        build.rows(columns(x) + constant(np.array([big])), high=0.0)


def test_excess_is_relative_to_the_magnitude():
    program = knapsack([1, 2], [1000.0, 1.0], 1000.0)
    assert program.excess(np.array([1.0, 0.0])) == 0
    np.testing.assert_allclose(program.excess(np.array([1.0, 1.0])), 1 / 1002)
    np.testing.assert_allclose(program.excess(np.array([0.25, 0.0])), 0.25)
    np.testing.assert_allclose(program.excess(np.array([0.0, 2.0])), 0.5)
    assert program.excess(np.array([np.nan, 0.0])) == np.inf


@pytest.mark.parametrize("solver", SOLVERS)
def test_all_loads_tried_by_hand(solver):
    rng = np.random.default_rng(3)
    values, weights = rng.random(9), rng.random(9)
    loads = (np.arange(2**9)[:, None] >> np.arange(9)) & 1
    best = (loads @ values)[loads @ weights <= 2].max()
    solution = solve(knapsack(values, weights, 2.0), solver=solver)
    assert solution.status == Status.OPTIMAL
    np.testing.assert_allclose(solution.incumbent, -best, atol=1e-6)
    assert solution.bound is not None
    assert solution.gap is not None
    assert solution.bound <= -best + 1e-6
    assert solution.gap <= 1e-4


@pytest.mark.parametrize("solver", SOLVERS)
def test_a_linear_program(solver):
    build = Builder()
    x = build.variables("x", (2,), lower=-np.inf, cost=1.0)
    build.rows(columns(x).map(sparse.csr_array(np.array([[2.0, 1.0], [1.0, 3.0]]))), low=np.array([4.0, 7.0]))
    solution = solve(build.program(), solver=solver)
    assert solution.status == Status.OPTIMAL
    assert solution.values is not None
    np.testing.assert_allclose(solution.values, [1, 2], atol=1e-6)
    np.testing.assert_allclose([solution.incumbent, solution.bound], 3, atol=1e-6)


@pytest.mark.parametrize("solver", SOLVERS)
def test_infeasible(solver):
    program = knapsack([1.0, 1.0], [2.0, 2.0], 3.0)
    solution = solve(replace(program, low=np.array([1.0]), high=np.array([1.5])), solver=solver)
    assert (solution.status, solution.values, solution.incumbent) == (Status.INFEASIBLE, None, None)
    assert solution.bound is None
    crossed = solve(replace(program, lower=np.array([0.0, 2.0])), solver=solver)
    assert (crossed.status, crossed.said) == (Status.INFEASIBLE, "contradictory bounds")
    # A row that nothing is in, and that cannot hold.
    empty = Linear(sparse.csr_array((1, 2)), np.zeros(1))
    build = Builder()
    build.variables("x", (2,), upper=1.0, cost=1.0)
    build.rows(empty, low=1.0)
    assert solve(build.program(), solver=solver).status == Status.INFEASIBLE


@pytest.mark.parametrize("solver", SOLVERS)
def test_unbounded_is_an_error_with_evidence(solver):
    build = Builder()
    x = build.variables("x", (2,), lower=-np.inf, cost=1.0)
    n = build.variables("n", (1,), integer=True)
    build.rows(columns(x[:1]) - columns(x[1:]) + columns(n), 0.0, 0.0)
    with pytest.raises(RepairError, match=r"no least cost.*columns 3.*binaries 1") as caught:
        solve(build.program(), solver=solver)
    assert caught.value.evidence["rows"] == 1


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("limits", [Limits(seconds=0.0), Limits(nodes=1)])
def test_no_incumbent_is_not_zeros(solver, limits):
    solution = solve(hard(), solver=solver, limits=limits)
    assert solution.status == Status.NO_INCUMBENT, solution.said
    assert (solution.values, solution.incumbent, solution.gap) == (None, None, None)


@pytest.mark.parametrize("solver", SOLVERS)
def test_at_a_limit_with_an_incumbent(solver):
    rng = np.random.default_rng(0)
    build = Builder()
    take = build.variables("take", (60,), integer=True)
    build.rows(columns(take).map(sparse.csr_array(rng.random((20, 60)))), high=12.0)
    program = replace(build.program(), cost=-rng.random(60))
    solution = solve(program, solver=solver, limits=Limits(nodes=1, gap=0.0))
    assert solution.status == Status.FEASIBLE, solution.said
    assert solution.values is not None
    assert solution.incumbent is not None
    assert solution.bound is not None
    assert program.excess(solution.values) <= 1e-6
    assert solution.bound < solution.incumbent < 0


def test_gurobis_own_words_are_told_apart():
    """Its model without Gurobi, whose licence may end at 2000 variables."""

    def optimize():
        raise ValueError("Model too large for size-limited license")

    model = types.SimpleNamespace(Status=9, SolCount=0, ObjBound=-4.0, NodeCount=7.0, optimize=optimize)
    answer = _of_gurobi(knapsack([1.0], [1.0], 1.0), model, np.zeros(1))
    assert (answer.ended, answer.said, answer.values, answer.bound) == ("limit", "TIME_LIMIT", None, -4)
    model.Status = 1
    with pytest.raises(RepairError, match=r"size-limited license.*columns 1"):
        _of_gurobi(knapsack([1.0], [1.0], 1.0), model, None)
    model.Status = 12
    assert _of_gurobi(knapsack([1.0], [1.0], 1.0), model, None).ended == "failed"


def test_a_start_is_an_incumbent():
    rng = np.random.default_rng(0)
    matrix, there = rng.integers(0, 100, (5, 40)).astype(float), rng.integers(0, 2, 40).astype(float)
    program = replace(hard(), matrix=sparse.csr_array(matrix), low=matrix @ there, high=matrix @ there)
    without = solve(program, solver="highspy", limits=Limits(nodes=0))
    with_start = solve(program, solver="highspy", limits=Limits(nodes=0), start=there)
    assert without.status == Status.NO_INCUMBENT
    assert with_start.values is not None
    np.testing.assert_allclose(with_start.values, there, atol=1e-6)
    with pytest.raises(SpecError, match="highspy"):
        solve(program, solver="SCIP", start=there)


def test_slack_that_is_used_makes_it_elastic():
    def program(room: float) -> Program:
        build = Builder()
        x = build.variables("x", (1,), upper=1.0, cost=1.0)
        slack = build.variables(SLACK, (1,), cost=10.0)
        build.rows(columns(x) + columns(slack), low=room)
        return build.program()

    assert solve(program(0.5)).status == Status.OPTIMAL
    over = solve(program(1.5))
    assert over.status == Status.ELASTIC
    np.testing.assert_allclose(over.incumbent, 1 + 10 * 0.5)


def test_same_seed_same_values():
    first, second = (solve(hard(1, 20), solver="highspy", limits=Limits(nodes=50)) for _ in range(2))
    assert (first.status, first.nodes, first.incumbent) == (second.status, second.nodes, second.incumbent)


def test_a_solver_that_lies_is_caught(monkeypatch):
    program = knapsack([1.0, 1.0], [2.0, 2.0], 3.0)
    wrong = replace(program, high=np.array([10.0]))
    import repair.solve as module

    honest = module._highspy
    monkeypatch.setattr(module, "_highspy", lambda _, limits, start: honest(wrong, limits, start))
    solution = solve(program, solver="highspy")
    assert (solution.status, solution.values) == (Status.NUMERICAL, None)


def test_missing_solvers_are_named(monkeypatch):
    monkeypatch.setattr("cvxpy.installed_solvers", lambda: ["HIGHS", "OSQP"])
    assert installed() == ["HIGHS", "highspy"]
    with pytest.raises(SolverMissing, match="GUROBI is not installed, HIGHS, highspy are; install gurobipy"):
        solve(hard(), solver="GUROBI")


@pytest.mark.parametrize("wrong", [{"seconds": -1.0}, {"nodes": -1}, {"gap": -0.1}, {"threads": 0}])
def test_limits_are_checked(wrong):
    with pytest.raises(SpecError):
        Limits(**wrong)
