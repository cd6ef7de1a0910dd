"""The generator of `--stability incremental`: a slope-restricted Lur'e layer whose trajectories come together.

    x(k+1) = A x + B u + F z,   z = tanh(Gx + Hu + b) − tanh(b),   y = C x [+ D u] + E z

which is NN-SS, x(k+1) = A(ρ)x + B(ρ)u, y = C(ρ)x [+ D(ρ)u], ρ = x or [x; u], with the slopes Δ(ρ) of tanh's secants,

    A(ρ) = A + F Δ G,   B(ρ) = B + F Δ H,   C(ρ) = C + E Δ G,   D(ρ) = D + E Δ H,   0 < Δ ≤ 1

The matrices follow from free ones (`nnss_cli.baselines.incremental`), always in float64: any two states come nearer by
γ a sample under one input; with a gain Γ, outputs differ by at most Γ times what the inputs do, in ℓ2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from nnss_cli.baselines.incremental import RIDGE, contraction_with_zero_inverse, incremental_margin
from nnss_cli.datasets.record import FloatArray
from nnss_cli.model.architecture import Architecture


class Plain(NamedTuple):
    """The matrices of the equations above; zero where an architecture has none."""

    A: Tensor
    B: Tensor
    F: Tensor
    G: Tensor
    H: Tensor
    b: Tensor
    C: Tensor
    D: Tensor
    E: Tensor


class PlainArrays(NamedTuple):
    """`Plain` in NumPy."""

    A: FloatArray
    B: FloatArray
    F: FloatArray
    G: FloatArray
    H: FloatArray
    b: FloatArray
    C: FloatArray
    D: FloatArray
    E: FloatArray


class Lure(nn.Module):
    """Free weights of the layer; `plain` makes its matrices of them.

    H are the rows of the units that see u, E the columns of those that y sees.
    """

    X: Tensor
    scale: Tensor

    def __init__(self, a: Architecture) -> None:
        """Zero weights."""
        super().__init__()
        self.a = a
        n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
        sizes = {
            "X": (q, n), "Y": (n, n + q), "scale": (q,), "bias": (q,), "H": (a.driven_units, r), "B": (n, r),
            "C": (m, n), "E": (m, a.shown_units), "D": (m, r) if a.feedthrough else (0, r),
        }  # fmt: skip
        self.sizes = {name: size for name, size in sizes.items() if min(size) > 0}
        for name, size in self.sizes.items():
            self.register_parameter(name, nn.Parameter(torch.zeros(size, dtype=getattr(torch, a.dtype))))

    def free(self) -> dict[str, Tensor]:
        """The weights by name."""
        return {name: getattr(self, name) for name in self.sizes}

    def plain(self, free: dict[str, Tensor] | None = None) -> Plain:
        """The layer's matrices in float64, from its weights or from others by name."""
        a = self.a
        n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
        given = {name: part.double() for name, part in (self.free() if free is None else free).items()}

        def part(name: str, *size: int) -> Tensor:
            return given.get(name, given["X"].new_zeros(size))

        X, Y, b = given["X"], given["Y"], given["bias"]
        H = torch.cat([part("H", 0, r), X.new_zeros(q - a.driven_units, r)])
        E = torch.cat([X.new_zeros(m, q - a.shown_units), part("E", m, 0)], dim=1)
        B, C, D = given["B"], given["C"], part("D", m, r)
        if a.gain:
            X = torch.cat([H, X], dim=1)
            Y = torch.cat([torch.cat([D, C, E], dim=1), torch.cat([B, Y], dim=1)])
        K1, K21 = _contraction_with_zero(X, Y, incremental_margin(a.gain_columns, a.dtype))
        scale = torch.exp(torch.asinh(given["scale"] / 2))  # Λ⁻¹: any positive number, 10⁻⁴ to 10⁴ for weights to 10⁴
        if a.gain:
            H, X = scale[:, None] * K21[:, :r], K21[:, r:]
            D, C, E = (a.gain * part for part in K1[:m].split((r, n, q), dim=1))
            B, Y = a.gamma * K1[m:, :r], K1[m:, r:]
            E = 2 * E / scale
        else:
            X, Y = K21, K1
        G = scale[:, None] * X
        F = 2 * a.gamma * Y[:, n:] / scale
        A = a.gamma * Y[:, :n] - F @ G / 2
        if a.gain:
            B, C = B - F @ H / 2, C - E @ G / 2
            D = D - E @ H / 2
        return Plain(A, B, F, G, H, b, C, D, E)

    def forward(self, rho: Tensor) -> Tensor:
        """W, V, B, C, D (·, their sizes) at scheduling points rho (·, ·): A in the corner of W, and V = 0."""
        a = self.a
        n, r = a.order, a.inputs
        found = self.plain()
        A, B, F, G, H, b, C, D, E = (part.to(rho.dtype) for part in found)
        v = rho[:, :n] @ G.T
        if a.driven_units:
            v = v + rho[:, n : n + r] @ H.T
        slopes = secant(v, b)
        W = rho.new_zeros(len(rho), 2 * n, 2 * n)
        inner = torch.cat([G, H], dim=1) * slopes[:, :, None]
        state, output = torch.cat([A, B], dim=1) + F @ inner, torch.cat([C, D], dim=1) + E @ inner
        W = torch.nn.functional.pad(state[:, :, :n], (0, n, 0, n))
        parts = [W, rho.new_zeros(len(rho), n, n), state[:, :, n:], output[:, :, :n]] + [
            output[:, :, n:]
        ] * a.feedthrough
        return torch.cat([part.flatten(1) for part in parts], dim=1)

    @torch.no_grad()
    def arrays(self) -> PlainArrays:
        """The matrices as a step has them: in the model's precision, as float64."""
        return PlainArrays(*(part.to(self.X.dtype).double().numpy() for part in self.plain()))

    @torch.no_grad()
    def promised_norm(self) -> float:
        """‖K‖₂ of the matrices as a step has them: below 1, γ and Γ are kept."""
        scale = np.exp(np.arcsinh(self.scale.double().numpy() / 2))
        K1, K21 = whole(self.arrays(), scale, self.a.gamma, self.a.gain)
        return float(np.linalg.norm(np.block([[K1], [K21, np.zeros((len(K21), len(K21)))]]), 2))

    def output_bounds(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Largest |B(ρ)|, |C(ρ)| and |D(ρ)|, entry by entry, over all slopes between 0 and 1."""
        _, B, F, G, H, _, C, D, E = self.arrays()

        def largest(M: FloatArray, left: FloatArray, right: FloatArray) -> FloatArray:
            steps = left[:, :, None] * right[None]
            above, below = M + np.maximum(steps, 0).sum(axis=1), M + np.minimum(steps, 0).sum(axis=1)
            return np.maximum(np.abs(above), np.abs(below))

        return largest(B, F, H), largest(C, E, G), largest(D, E, H)

    @torch.no_grad()
    def place(self, plain: PlainArrays, scale: FloatArray) -> None:
        """Set the weights such that `plain` gives these matrices, in closed form.

        Args:
            plain: with zeros where the architecture has none.
            scale: Λ⁻¹ (q,) for which they keep the promise.

        Raises:
            InputError: they do not, or leave its margin no room.
        """
        a = self.a
        K1, K21 = whole(plain, scale, a.gamma, a.gain)
        X, Y = contraction_with_zero_inverse(K1, K21, incremental_margin(a.gain_columns, a.dtype))
        n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
        values = {"X": X, "Y": Y, "H": plain.H, "B": plain.B, "C": plain.C, "E": plain.E, "D": plain.D}
        if a.gain:
            D, C, E = np.split(Y[:m], (r, r + n), axis=1)
            values = {"H": X[:, :r], "X": X[:, r:], "D": D, "C": C, "E": E, "B": Y[m:, :r], "Y": Y[m:, r:]}
        values["H"], values["E"] = values["H"][: a.driven_units], values["E"][:, q - a.shown_units :]
        values |= {"scale": scale - 1 / scale, "bias": plain.b}
        for name, parameter in self.free().items():
            parameter.copy_(torch.from_numpy(np.ascontiguousarray(values[name])))


def whole(plain: PlainArrays, scale: FloatArray, gamma: float, gain: float) -> tuple[FloatArray, FloatArray]:
    """K₁ and K₂₁ of a layer: without columns for u and rows for y where no gain (0) is asked for."""
    A, B, F, G, H, _, C, D, E = plain
    state = (A + F @ G / 2) / gamma, F * scale / (2 * gamma)
    if not gain:
        return np.concatenate(state, axis=1), G / scale[:, None]
    output = (D + E @ H / 2) / gain, (C + E @ G / 2) / gain, E * scale / (2 * gain)
    K1 = np.concatenate([np.concatenate(output, axis=1), np.concatenate([(B + F @ H / 2) / gamma, *state], axis=1)])
    return K1, np.concatenate([H, G], axis=1) / scale[:, None]


def secant(v: Tensor, b: Tensor) -> Tensor:
    """(tanh(v + b) − tanh(b))/v, with tanh(v + b) − tanh(b) = tanh(v) (1 − tanh(b) tanh(v + b))."""
    small = v.abs() < 1e-3
    safe = torch.where(small, torch.ones_like(v), v)
    steep = torch.where(small, 1 - v**2 / 3 + 2 * v**4 / 15, torch.tanh(safe) / safe)
    return steep * (1 - torch.tanh(b) * torch.tanh(v + b))


def advance(plain: Plain, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """x(k+1) (·, n) and y(k) (·, m) from x (·, n) and u (·, r), in the precision of the matrices."""
    A, B, F, G, H, b, C, D, E = plain
    z = torch.tanh(x @ G.T + u @ H.T + b) - torch.tanh(b)
    return x @ A.T + u @ B.T + z @ F.T, x @ C.T + u @ D.T + z @ E.T


def _contraction_with_zero(X: Tensor, Y: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """`nnss_cli.baselines.incremental.contraction_with_zero` in torch."""
    c, p = X.shape[1], len(Y)
    s = 1 + RIDGE * X.square().sum()
    L2 = torch.linalg.cholesky(s * torch.eye(c, dtype=X.dtype) + X.T @ X)
    L1 = torch.linalg.cholesky((1 + RIDGE * Y.square().sum()) * torch.eye(p, dtype=X.dtype) + Y @ Y.T)
    theta = torch.linalg.solve_triangular(L1, Y, upper=False)
    Z = torch.sqrt(s) * torch.linalg.solve_triangular(L2.T, torch.eye(c, dtype=X.dtype), upper=True)
    K1 = torch.cat([theta[:, :c] @ Z, theta[:, c:]], dim=1)
    return (1 - margin) * K1, (1 - margin) * torch.linalg.solve_triangular(L2.T, X, upper=True, left=False)
