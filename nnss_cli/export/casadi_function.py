"""CasADi functions: the step, the start and the exact Jacobians, as files that `casadi.Function.load` reads."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.elementary import Array, Node, Program
from nnss_cli.export.parity import Parity, ParityError, Trial, check
from nnss_cli.system import System
from nnss_cli.trained import TrainedModel

TOLERANCE = 1e-10
POINTS = 20  # of the trial at which Jacobians are compared
NEAR, JUMP = 1e-9, 1e-5  # a step aside, and how much slopes may differ there, both relative to 1 + the size
DIRECTIONS = 8  # of such steps


def write_casadi(model: TrainedModel, facts: dict[str, Any], trial: Trial, folder: Path, name: str) -> list[Parity]:
    """<name>_step.casadi, <name>_initial.casadi and <name>_jacobian.casadi, each checked."""
    del facts
    import casadi

    system = model.system
    step = _function(casadi, f"{name}_step", system.step, ("z_next", "y"))
    z, u = casadi.SX.sym("z", system.size), casadi.SX.sym("u", system.inputs)
    z_next, y = step(z, u)
    parts = [casadi.jacobian(of, by) for of in (z_next, y) for by in (z, u)]
    jacobian = casadi.Function(f"{name}_jacobian", [z, u], parts, ["z", "u"], ["A", "B", "C", "D"])
    for function in (step, _function(casadi, f"{name}_initial", system.initial, ("z",)), jacobian):
        function.save(str(folder / f"{function.name()}.casadi"))
    loaded = {
        part: casadi.Function.load(str(folder / f"{name}_{part}.casadi")) for part in ("step", "initial", "jacobian")
    }
    return [_check(loaded, system, trial)]


def _operations(casadi: Any) -> Mapping[str, Callable[..., Any]]:
    def part(node: Node, a: Any) -> Any:
        i, j, k, l = node.part  # noqa: E741
        return a[i:j, k:l]

    return {
        "add": lambda _, a, b: a + b,
        "subtract": lambda _, a, b: a - b,
        "multiply": lambda _, a, b: a * b,
        "divide": lambda _, a, b: a / b,
        "less": lambda _, a, b: a < b,
        "product": lambda _, a, b: casadi.mtimes(a, b),
        "transpose": lambda _, a: a.T,
        # its matrices lie column by column
        "reshape": lambda node, a: casadi.reshape(a.T, node.shape[1], node.shape[0]).T,
        "part": part,
        "rows": lambda _, *parts: casadi.vertcat(*parts),
        "columns": lambda _, *parts: casadi.horzcat(*parts),
        "sum": lambda _, a: casadi.sum1(casadi.sum2(a)),
        "root": lambda _, a: casadi.sqrt(a),
        # 1/(1 + exp(−a)) of which the derivative does not overflow either
        "sigmoid": lambda _, a: 0.5 * (1 + casadi.tanh(0.5 * a)),
    }


def _function(casadi: Any, name: str, program: Program, results: tuple[str, ...]) -> Any:
    arguments = {a: casadi.SX.sym(a, *program.nodes[number].shape) for a, number in program.inputs.items()}
    found = program.run(arguments, _operations(casadi), lambda _, value: casadi.SX(casadi.DM(value)))
    return casadi.Function(
        name, list(arguments.values()), [found[result] for result in results], list(arguments), list(results)
    )


def _check(functions: Mapping[str, Any], system: System, trial: Trial) -> Parity:
    K, step = len(trial.u), functions["step"]
    z_next, y = step.map(K)(trial.z.T, trial.u.T)
    simulated = step.mapaccum(K)(trial.z[0], trial.u.T)[1]
    branches = any(node.operation == "less" for node in system.step.nodes)
    for k in np.unique(np.linspace(0, K - 1, POINTS).astype(int)):
        z, u = trial.z[k], trial.u[k]
        own = system.jacobians(z, u)
        if branches and not _smooth(system, z, u, own):
            continue
        for found, expected in zip(functions["jacobian"](z, u), own, strict=True):
            error = float(np.max(np.abs(found.full() - expected) / (1 + np.abs(expected)), initial=0.0))
            if not error <= TOLERANCE:
                raise ParityError(f"CasADi: a Jacobian is {error:.1e} off the model's; no file was written")
    started = functions["initial"](trial.y0, trial.u0).full()[:, 0]
    return check("CasADi", trial, (z_next.full().T, y.full().T), simulated.full().T, TOLERANCE, started)


def _smooth(system: System, z: Array, u: Array, here: Sequence[Array]) -> bool:
    """Whether the slopes `here` are the only ones: where members of an ensemble agree, which one counts is chance."""
    aside = NEAR * (1 + np.abs(z))
    for signs in np.random.default_rng(0).choice([-1.0, 1.0], (DIRECTIONS, len(z))):
        there = system.jacobians(z + signs * aside, u)
        if not all(np.allclose(a, b, rtol=JUMP, atol=JUMP) for a, b in zip(here, there, strict=True)):
            return False
    return True
