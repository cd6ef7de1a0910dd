"""A nonlinear model near a point: its frozen matrices, its equilibria, and its linearisation there.

Frozen matrices are no linearisation. With ρ = x, x(k+1) = A(x) x + B(x) u has the derivative

    ∂x(k+1)/∂x = A(x) + Σᵢ (∂A/∂xᵢ x + ∂B/∂xᵢ u) eᵢᵀ

of which A(x) is the first term. docs/api.md shows how far apart the two may be.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray
from nnss_cli.errors import InputError
from nnss_cli.system import System

SETTLING = 1000  # samples under the constant input, from which Newton's steps set out
ITERATIONS = 50
EXACT = 1e-11  # relative residual of an equilibrium; its rounding errors are some 1e-14


@dataclass(frozen=True, eq=False)
class Frozen:
    """x(k+1) = A x(k) + B (u(k) − u_mean),  y(k) = C x(k) + D (u(k) − u_mean) + y_mean, at one scheduling point.

    u and y are in physical units, x are the model's own states. `A, B, C = frozen` and, of a model with feedthrough,
    `A, B, C, D = frozen`.
    """

    A: FloatArray
    """State matrix (n, n)."""
    B: FloatArray
    """Input matrix (n, r), per physical unit of the inputs."""
    C: FloatArray
    """Output matrix (m, n), in physical units of the outputs."""
    D: FloatArray
    """Feedthrough (m, r); zeros of a model without."""
    u_mean: FloatArray
    """The input (r,) that counts as zero."""
    y_mean: FloatArray
    """The output (m,) that counts as zero."""
    feedthrough: bool
    """Whether the model has a D."""

    def __iter__(self) -> Iterator[FloatArray]:
        return iter((self.A, self.B, self.C, self.D) if self.feedthrough else (self.A, self.B, self.C))


@dataclass(frozen=True, eq=False)
class Equilibrium:
    """Where a constant input holds the model: z = f(z, u), y = h(z, u)."""

    z: FloatArray
    """x and, of a model scheduled on it, the previous output (N,)."""
    u: FloatArray
    """The input (r,), physical units."""
    y: FloatArray
    """The output (m,), physical units."""


def frozen(system: System, z: FloatArray, u: FloatArray) -> Frozen:
    """The matrices at z (N,) and u (r,)."""
    found = system.frozen(z=z[:, None], u=u[:, None])
    A, B, C, D = (found[name] for name in "ABCD")
    return Frozen(A, B, C, D, system.u_mean, system.y_mean, system.feedthrough)


def equilibrium(system: System, u: FloatArray) -> Equilibrium:
    """The equilibrium under a constant input u (r,) that is reached from the mean output, else one that Newton finds.

    The model is run under the input, `SETTLING` samples at most. Newton's steps, with exact derivatives, go on from
    where that leads, be it settled or not; from the start, where it leaves the range of numbers or they fail; and from
    0. Of several equilibria, the one that is found where the path has not settled may be any.

    Raises:
        InputError: none is found.
    """
    begin = system.start(np.tile(system.y_mean, system.first), np.tile(u, system.first))
    settled, path = begin, begin
    for _ in range(SETTLING):
        path, _ = system.advance(settled, u)
        if not np.isfinite(path).all():
            settled = begin
            break
        if np.allclose(path, settled, rtol=EXACT, atol=EXACT):
            break
        settled = path
    residuals = []
    for start in (settled, begin, np.zeros(system.size)):
        z, residual = _newton(system, start, u)
        if residual <= EXACT:
            return Equilibrium(z, u, system.advance(z, u)[1])
        residuals.append(residual)
    raise InputError(
        f"u = {', '.join(f'{value:.6g}' for value in u)}: expected an equilibrium of the model, found none (|f(x) − x| "
        f"stays above {min(residuals):.2g}): take an input at which the plant comes to rest, within the training range"
    )


def _newton(system: System, z: FloatArray, u: FloatArray) -> tuple[FloatArray, float]:
    """z − f(z, u) = 0 by Newton's steps, halved until the residual falls; and the relative residual reached."""

    def residual(at: FloatArray) -> tuple[FloatArray, float]:
        error = at - system.advance(at, u)[0]
        size = float(np.linalg.norm(error)) / (1 + float(np.linalg.norm(at)))
        return error, size if np.isfinite(size) else np.inf

    error, size = residual(z)
    for _ in range(ITERATIONS):
        if size <= EXACT or not np.isfinite(size):
            break
        A = system.jacobians(z, u)[0]
        step = np.linalg.lstsq(np.eye(len(z)) - A, error, rcond=None)[0]
        for share in 0.5 ** np.arange(12):
            candidate = z - share * step
            error_there, size_there = residual(candidate)
            if size_there < size:
                z, error, size = candidate, error_there, size_there
                break
        else:
            break
    return z, size


def control_names(channels: Channels) -> tuple[list[str], list[str]]:
    """Names of the inputs and the outputs that python-control accepts: with '_' for each '.', which it refuses.

    Where another channel has that name already, '_2', '_3', … follow it: control connects signals of the same name.
    """
    taken = {*channels.inputs, *channels.outputs}

    def accepted(name: str) -> str:
        if "." not in name:
            return name
        plain = name.replace(".", "_")
        endings = itertools.chain([""], (f"_{number}" for number in itertools.count(2)))
        found = next(plain + ending for ending in endings if plain + ending not in taken)
        taken.add(found)
        return found

    return list(map(accepted, channels.inputs)), list(map(accepted, channels.outputs))


def linearised(system: System, channels: Channels, Ts: float, u: FloatArray) -> Any:
    """The Jacobians at the equilibrium under u (r,), as a control.StateSpace of deviations from it.

    Raises:
        InputError: there is no equilibrium.
    """
    import control

    A, B, C, D = system.jacobians(equilibrium(system, u).z, u)
    inputs, outputs = control_names(channels)
    return control.ss(A, B, C, D, Ts, inputs=inputs, outputs=outputs, states=list(system.state_names))


def to_control(system: System, channels: Channels, Ts: float) -> Any:
    """The whole model as a control.NonlinearIOSystem: physical units, states z of `System`."""
    import control

    def update(_: float, z: FloatArray, u: FloatArray, __: Any) -> FloatArray:
        return system.advance(np.asarray(z, dtype=np.float64), np.reshape(u, -1))[0]

    def output(_: float, z: FloatArray, u: FloatArray, __: Any) -> FloatArray:
        return system.advance(np.asarray(z, dtype=np.float64), np.reshape(u, -1))[1]

    inputs, outputs = control_names(channels)
    return control.nlsys(
        update, output, inputs=inputs, outputs=outputs, states=list(system.state_names), dt=Ts, name="model"
    )
