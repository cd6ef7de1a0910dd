"""What can be promised of a model's stability, and what was seen.

A(ρ) Schur at every frozen ρ does not make x(k+1) = A(ρ(k)) x(k) + B(ρ(k)) u(k) stable: products of Schur matrices can
grow without bound (docs/stability.md has an example). ‖A(ρ)‖₂ < γ does, for then, γ < 1,

    ‖x(k)‖ ≤ γᵏ ‖x(0)‖ + (1 − γᵏ) R ≤ max(‖x(0)‖, R),   R = sup‖B‖ sup‖u‖ / (1 − γ)

The generator's last hidden layer is a sigmoid, so sup‖B‖ and sup‖C‖ follow from the last layer's weights, whatever
schedules. For other models a matrix P with A(ρ)ᵀ P A(ρ) ≺ P is searched, for sampled ρ only; of a linear model the
only A decides. All in normalised units.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.iterative import named_random
from nnss_cli.model.incremental import Lure
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights

SAMPLES = 4096  # points of the box
CLIMBERS, CLIMBS = 32, 60  # gradient ascent in the box: starts and steps
WIDER = 0.5  # the box is the range of the trajectories, wider by this share on either side
LYAPUNOV_POINTS = 150
STRESS_STEPS, CHUNK = 1_000_000, 20_000
HORIZON, ASCENTS, RESTARTS = 120, 25, 8  # of the adversarial input
NORM_BOUNDED = ("quadratic", "incremental")  # ‖A(ρ)‖ < γ by construction
INPUTS = ("zero", "highest", "lowest", "white", "sweep", "square", "adversarial", "adversarial, held")


@dataclass(frozen=True)
class Stress:
    """The largest values of a long run."""

    input: str
    """Which input."""
    steps: int
    """Samples simulated; fewer than asked for where the state left the range of numbers."""
    state: float
    """Largest ‖x‖."""
    output: float
    """Largest |y|, any output; of an integrator's model, what it sums up."""


@dataclass(frozen=True)
class Certificate:
    """What `certify` found."""

    kind: str
    """nnss or linear."""
    stability: str
    """schur, quadratic, incremental, none, or linear."""
    covers: str
    """The model, or its LPV part alone where an integrator follows."""
    gamma: float
    """The promised bound: on ρ(A) for schur, on ‖A‖₂ for quadratic and incremental; inf where nothing is promised."""
    records: int
    """Number N of records given."""
    holds_for: str
    """The initial states and inputs for which `state_bound` holds; "" where there is none."""
    radius: dict[str, float]
    """Largest ρ(A) along each split's trajectories."""
    state: dict[str, float]
    """Largest ‖x‖ along each split's trajectories."""
    initial_state: float
    """Largest ‖x(0)‖ of the records."""
    box_radius: float
    """Largest ρ(A) found over the box: sampled, then by gradient ascent."""
    box_norm: float
    """Largest ‖A‖₂ found likewise."""
    state_bound: float | None
    """Certified sup‖x‖ for what `holds_for` says, in exact arithmetic; None where there is none."""
    invariant_radius: float | None
    """R: the ball ‖x‖ ≤ R is never left under such inputs, and every state tends to it; None where there is none."""
    B_bound: float
    """sup‖B(ρ)‖₂ from the weights."""
    C_bound: float
    """sup‖C(ρ)‖₂ from the weights."""
    D_bound: float
    """sup‖D(ρ)‖₂ from the weights; 0 without feedthrough."""
    input_bound: float
    """sup‖u‖ of the box of the records' inputs, at its outermost corner; any u of this norm is covered, 0 too."""
    lyapunov: str
    """What the search for a common P gave."""
    lyapunov_rate: float | None
    """Smallest rate for which P was found, for the sampled set only; ρ(A) < 1 of a linear model; else None."""
    stress: tuple[Stress, ...]
    """Long runs."""
    stress_seconds: float
    """Wall time of the long runs [s]."""
    broken: tuple[str, ...] = field(default=())
    """Promised bounds that do not hold; empty for a sound model."""

    def to_json(self) -> dict[str, Any]:
        """As plain data; numbers that are not finite as null."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def certify(
    model: Any, splits: dict[str, tuple[Record, ...]], steps: int = STRESS_STEPS, search_lyapunov: bool = True
) -> Certificate:
    """Examine a model on the trajectories of these records (physical units) and far beyond.

    Args:
        model: NNSS or LinearModel.
        splits: records by name; their range of inputs bounds the stress runs, which start from the largest x(0).
        steps: of each stress run; 0 for none, which leaves all that is certified.
        search_lyapunov: solve the LMI where a common Lyapunov matrix is not given by construction.

    Raises:
        InputError: the model is of another kind, or the records have other channels.
    """
    if not isinstance(model, NNSS | LinearModel):
        raise InputError(
            f"certify: expected one NN-SS or linear model, found {type(model).__name__}; certify its members"
        )
    system = _Neural(model) if isinstance(model, NNSS) else _Linear(model)
    scaling = model.scaling
    scaled = {name: tuple(scaling.apply(record) for record in records) for name, records in splits.items()}
    everything = [record for records in scaled.values() for record in records]
    if not everything:
        raise InputError("certify: expected at least one record, found none")
    low = np.min([record.u.min(axis=0) for record in everything], axis=0)
    high = np.max([record.u.max(axis=0) for record in everything], axis=0)
    runs = {name: [system.trajectory(record) for record in own] for name, own in scaled.items() if own}
    points = {
        name: np.concatenate([system.scheduling(record, *run) for record, run in zip(scaled[name], own, strict=True)])
        for name, own in runs.items()
    }
    radius = {name: float(_radii(system.matrices(rho)).max()) for name, rho in points.items()}
    state = {name: max(_largest(x) for _, x in own) for name, own in runs.items()}
    seen = np.concatenate(list(points.values()))
    box_radius, box_norm, extremes = _over_box(system, seen)
    lyapunov, rate = "not needed: ‖x‖² is one by construction", None
    if isinstance(system, _Linear):
        lyapunov, rate = only_lyapunov(system.system.A)
    elif system.stability not in NORM_BOUNDED:
        lyapunov, rate = "not searched", None
        if search_lyapunov:
            lyapunov, rate = common_lyapunov(system.matrices(_spread(seen, extremes)))
    initial = [system.initial_state(record) for record in everything]
    farthest = int(np.argmax([np.linalg.norm(x0) for x0 in initial]))
    start = everything[farthest].y[0], initial[farthest]
    largest_initial = float(np.linalg.norm(initial[farthest]))
    started = time.perf_counter()
    stress: tuple[Stress, ...] = ()
    if steps:
        stress = _stress(system, system.adversary(low, high, *start), low, high, *start, steps)
    seconds = time.perf_counter() - started
    input_bound = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    B_bound, C_bound, D_bound = system.output_bounds()
    bound = invariant = None
    holds_for, limit = "", math.inf
    if isinstance(system, _Neural) and system.stability in NORM_BOUNDED and system.gamma < 1:
        invariant = B_bound * input_bound / (1 - system.gamma)
        bound = max(largest_initial, invariant)
        limit = bound * (1 + system.rounding())
        holds_for = f"x(0) = g(y(0)) of the {len(everything)} records given, inputs within their range"
    broken = []
    largest = max(box_radius, *radius.values())
    if largest >= system.gamma:
        broken.append(f"spectral radius {largest:.8g}, promised below {system.gamma:g}")
    if system.stability in NORM_BOUNDED and box_norm >= system.gamma:
        broken.append(f"norm {box_norm:.8g}, promised below {system.gamma:g}")
    if isinstance(system, _Neural) and isinstance(system.model.generator, Lure):
        size = system.model.generator.promised_norm()
        if not size < 1:
            broken.append(f"matrix of the layer's promise: norm {size:.8g}, expected below 1")
    if bound is not None:
        reached = [(largest, f"along a record of '{name}'") for name, largest in state.items()]
        reached += [(run.state, f"under input '{run.input}'") for run in stress]
        broken += [f"state {x:.4g} {where}, promised at most {bound:.4g}" for x, where in reached if not x <= limit]
    return Certificate(
        system.kind, system.stability, system.covers, system.gamma, len(everything), holds_for, radius, state,
        largest_initial, box_radius, box_norm, bound, invariant, B_bound, C_bound, D_bound, input_bound, lyapunov, rate,
        stress, seconds, tuple(broken),
    )  # fmt: skip


def only_lyapunov(A: FloatArray) -> tuple[str, float | None]:
    """Whether P ≻ 0 with AᵀPA ≺ P exists for one A, which is exact: where ρ(A) < 1, for any rate above ρ(A)."""
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if radius >= 1:
        return f"none: ρ(A) = {radius:.6g}, and A is the only one", None
    return "exists: ρ(A) < 1, and A is the only one", radius


def common_lyapunov(matrices: FloatArray) -> tuple[str, float | None]:
    """Search P ≻ 0 and the smallest rate r with AᵀPA ≼ r²P for all matrices (N, n, n), by bisection on r up to 1.

    Returns:
        What was found, in words, and the rate (None where there is none below 1). It says nothing about
        matrices that are not among them.
    """
    try:
        import cvxpy as cp
    except ModuleNotFoundError:
        return "not searched: pip install 'nnss[certify]'", None
    n = matrices.shape[1]
    floor = float(_radii(matrices).max())
    if floor >= 1:
        return f"none: ρ(A) = {floor:.6g} somewhere in the sampled set", None

    def solution(rate: float) -> FloatArray | None:
        P = cp.Variable((n, n), symmetric=True)
        t = cp.Variable()
        constraints = [P >> np.eye(n), P << t * np.eye(n)]
        constraints += [rate**2 * P - A.T @ P @ A >> 1e-9 * np.eye(n) for A in matrices]
        problem = cp.Problem(cp.Minimize(t), constraints)
        try:
            problem.solve(solver=cp.CLARABEL)
        except (cp.SolverError, ValueError):
            return None
        if P.value is None:
            return None
        # trusted only as far as the eigenvalues, computed here, bear it out
        L = np.linalg.cholesky((P.value + P.value.T) / 2)
        moved = np.linalg.solve(L, np.swapaxes(matrices, 1, 2) @ L)  # L⁻¹ AᵀL has the norm of A in the metric P
        worst = float(np.linalg.norm(moved, 2, axis=(1, 2)).max())
        return P.value if worst <= rate * (1 + 1e-7) else None

    if solution(1.0) is None:
        return f"none found for the {len(matrices)} sampled A(ρ)", None
    low, high = floor, 1.0
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (low, middle) if solution(middle) is not None else (middle, high)
    return f"found for the {len(matrices)} sampled A(ρ); says nothing about others", high


class _Neural:
    kind = "nnss"

    def __init__(self, model: NNSS) -> None:
        integrates = model.architecture.integrator
        self.covers = (
            "the LPV part: the outputs integrate what it gives and have no bound" if integrates else "the model"
        )
        model = model.lpv_part()
        self.model, self.weights = model, Weights(model)
        a = self.architecture = model.architecture
        self.stability = a.stability
        self.gamma = a.gamma if a.stability != "none" else math.inf

    def trajectory(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """y (K, m) and x (K, n) of a record, simulated from y(0)."""
        return self.weights.free_run(record.u, record.y[0])

    def scheduling(self, record: Record, y: FloatArray, x: FloatArray) -> FloatArray:
        """ρ along the trajectory of a record (K, ·)."""
        previous = np.concatenate([record.y[:1], y[:-1]])
        parts = self.architecture.scheduling.split("+")
        rho = np.concatenate([x] + [record.u] * ("u" in parts) + [previous] * ("y" in parts), axis=1)
        finite = rho[np.isfinite(rho).all(axis=1)]
        return finite if len(finite) else rho[:1]

    def torch_matrices(self, rho: torch.Tensor) -> torch.Tensor:
        W, V, *_ = self.model.matrices(rho)
        return self.model.state_matrix(W, V)

    @torch.no_grad()
    def matrices(self, rho: FloatArray) -> FloatArray:
        """A(ρ) (N, n, n)."""
        return np.asarray(self.torch_matrices(torch.tensor(rho, dtype=self.model.dtype)).numpy(), dtype=np.float64)

    def initial_state(self, record: Record) -> FloatArray:
        first = np.asarray(record.y[0], self.weights.vector.dtype)
        return self.weights.encode(first[:, None])[:, 0].astype(np.float64)

    def rounding(self) -> float:
        """Relative excess over `state_bound` that rounding explains: η/(1 − γ (1 + η)) where a step errs by η = k u.

        k counts the products that an entry of B and one of x(k+1) sum up, and a sigmoid's last bit.
        """
        a = self.architecture
        eta = (a.hidden[-1] + 2 * a.order + a.inputs + 2) * float(np.finfo(a.dtype).eps)
        return eta / max(1 - self.gamma * (1 + eta), eta)

    def output_bounds(self) -> tuple[float, float, float]:
        """sup‖B‖₂, sup‖C‖₂ and sup‖D‖₂: entry by entry over all outputs in [0, 1] of the last sigmoid layer."""
        a = self.architecture
        if isinstance(self.model.generator, Lure):
            B, C, D = self.model.generator.output_bounds()
            return float(np.linalg.norm(B, 2)), float(np.linalg.norm(C, 2)), float(np.linalg.norm(D, 2))
        layer: Any = self.model.generator[-1]
        weight, bias = (tensor.detach().numpy().astype(np.float64) for tensor in (layer.weight, layer.bias))
        highest = bias + np.maximum(weight, 0).sum(axis=1)
        lowest = bias + np.minimum(weight, 0).sum(axis=1)
        largest = np.maximum(np.abs(highest), np.abs(lowest))
        _, _, B, C, D = np.split(largest, np.cumsum(a.parameter_sizes[:-1]))
        B, C = B.reshape(a.order, a.inputs), C.reshape(a.outputs, a.order)
        D = D.reshape(a.outputs, a.inputs) if a.feedthrough else np.zeros((1, 1))
        return float(np.linalg.norm(B, 2)), float(np.linalg.norm(C, 2)), float(np.linalg.norm(D, 2))

    def run(self, u: FloatArray, y0: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.weights.free_runs(u, y0, x0)

    @torch.no_grad()
    def next_state(self, x: FloatArray, u: FloatArray, y_previous: FloatArray) -> FloatArray:
        """x(k+1) (n, b) from x(k) (n, b), u(k) (r, b) and y(k−1) (m, b)."""
        at = [torch.tensor(part.T.copy(), dtype=self.model.dtype) for part in (x, u, y_previous)]
        return np.asarray(self.model.step(*at)[0].numpy().T)

    def adversary(self, low: FloatArray, high: FloatArray, y0: FloatArray, x0: FloatArray) -> FloatArray:
        """Inputs (HORIZON, r) inside the range that drive ‖x‖ as far as gradient ascent finds, from x(0) = g(y(0))."""
        del x0
        a, dtype = self.architecture, self.model.dtype
        random = named_random(0, "adversary")
        middle, half = torch.tensor((high + low) / 2, dtype=dtype), torch.tensor((high - low) / 2, dtype=dtype)
        free = torch.tensor(random.uniform(-1, 1, (RESTARTS, HORIZON, a.inputs)), dtype=dtype)
        first = torch.tensor(np.tile(y0, (RESTARTS, 1)), dtype=dtype)
        best, reached = free[0].clone(), -1.0
        for step in range(ASCENTS):
            free.requires_grad_(True)
            _, x = self.model(middle + half * free, first)
            norms = torch.linalg.norm(x[:, -1], dim=1)
            (slope,) = torch.autograd.grad(norms.sum(), free)
            with torch.no_grad():
                leader = int(torch.nan_to_num(norms, nan=-1.0).argmax())
                if float(norms[leader]) > reached:
                    best, reached = free[leader].detach().clone(), float(norms[leader])
                free = (free + 0.5 / (1 + step / 5) * torch.sign(torch.nan_to_num(slope))).clamp(-1, 1).detach()
        return np.asarray((middle + half * best).numpy(), dtype=np.float64)


class _Linear:
    kind = stability = "linear"
    covers = "the model"
    gamma = math.inf  # a linear method promises nothing

    def __init__(self, model: LinearModel) -> None:
        self.system = model.system

    def trajectory(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """y (K, m) and x (K, n) of a record, simulated from y(0)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.system.simulate(record.u, self.initial_state(record))

    def scheduling(self, record: Record, y: FloatArray, x: FloatArray) -> FloatArray:
        """Nothing schedules: one point stands for all."""
        del record, y, x
        return np.zeros((1, 1))

    def matrices(self, rho: FloatArray) -> FloatArray:
        return np.repeat(self.system.A[None], len(rho), axis=0)

    def initial_state(self, record: Record) -> FloatArray:
        return self.system.state_from_output(record.y[0], record.u[0])

    def output_bounds(self) -> tuple[float, float, float]:
        B, C, D = (float(np.linalg.norm(part, 2)) for part in (self.system.B, self.system.C, self.system.D))
        return B, C, D

    def run(self, u: FloatArray, y0: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        del y0
        both = [self.system.simulate(np.ascontiguousarray(u[:, :, c]), x0[:, c]) for c in range(u.shape[2])]
        return np.stack([y for y, _ in both], axis=2), np.stack([x for _, x in both], axis=2)

    def next_state(self, x: FloatArray, u: FloatArray, y_previous: FloatArray) -> FloatArray:
        del y_previous
        with np.errstate(over="ignore", invalid="ignore"):
            return self.system.A @ x + self.system.B @ u

    def adversary(self, low: FloatArray, high: FloatArray, y0: FloatArray, x0: FloatArray) -> FloatArray:
        """For a fixed direction d of x(K) the worst input is the sign of Bᵀ (Aᵀ)^(K−1−k) d; d follows x(K) then."""
        del y0
        A, B = self.system.A, self.system.B
        d = np.ones(len(A)) / np.sqrt(len(A))
        u = np.zeros((HORIZON, B.shape[1]))
        for _ in range(ASCENTS):
            with np.errstate(over="ignore", invalid="ignore"):
                back = d
                for k in range(HORIZON - 1, -1, -1):
                    u[k] = np.where(B.T @ back > 0, high, low)
                    back = A.T @ back
                x = x0
                for sample in u:
                    x = A @ x + B @ sample
            if not np.isfinite(x).all() or not np.linalg.norm(x) > 0:
                break
            d = x / np.linalg.norm(x)
        return u


def _largest(x: FloatArray) -> float:
    """Largest ‖x‖ of (K, n); infinite where the state left the range of numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.linalg.norm(x.astype(np.float64), axis=1).max())
    return largest if math.isfinite(largest) else math.inf


def _radii(matrices: FloatArray) -> FloatArray:
    return np.asarray(np.abs(np.linalg.eigvals(matrices)).max(axis=1))


def _over_box(system: _Neural | _Linear, seen: FloatArray) -> tuple[float, float, FloatArray]:
    """Largest ρ(A) and ‖A‖₂ over a box around the ρ seen, and the points where they were found."""
    low, high = seen.min(axis=0), seen.max(axis=0)
    low, high = low - WIDER * (high - low), high + WIDER * (high - low)
    rho = named_random(0, "box").uniform(low, high, (SAMPLES, seen.shape[1]))
    A = system.matrices(rho)
    largest = []
    extremes = []
    for measure in (_radii, lambda A: np.linalg.norm(A, 2, axis=(1, 2))):
        values = measure(A)
        starts = rho[np.argsort(-values)[:CLIMBERS]]
        ends = _climb(system, starts, low, high, measure is _radii)
        largest.append(float(max(values.max(), measure(system.matrices(ends)).max())))
        extremes.append(ends)
    return largest[0], largest[1], np.concatenate(extremes)


def _climb(
    system: _Neural | _Linear, starts: FloatArray, low: FloatArray, high: FloatArray, radius: bool
) -> FloatArray:
    """Projected gradient ascent of ρ(A) or ‖A‖₂ inside the box."""
    if isinstance(system, _Linear):
        return starts
    model = system.model
    bottom, width = torch.tensor(low, dtype=model.dtype), torch.tensor(np.maximum(high - low, 1e-12), dtype=model.dtype)
    best = torch.tensor(starts, dtype=model.dtype)
    best_value = torch.full((len(starts),), -math.inf, dtype=model.dtype)
    at = ((best - bottom) / width).clamp(0, 1)
    for step in range(CLIMBS):
        at.requires_grad_(True)
        rho = bottom + width * at
        A = system.torch_matrices(rho)
        values = torch.linalg.eigvals(A).abs().amax(dim=1) if radius else torch.linalg.matrix_norm(A, 2)
        (slope,) = torch.autograd.grad(values.sum(), at)
        with torch.no_grad():
            better = values > best_value
            best = torch.where(better[:, None], rho, best)
            best_value = torch.where(better, values, best_value)
            slope = torch.nan_to_num(slope)
            direction = slope / slope.abs().amax(dim=1, keepdim=True).clamp(min=1e-30)
            at = (at + 0.1 / (1 + step / 5) * direction).clamp(0, 1).detach()
    return np.asarray(best.detach().numpy(), dtype=np.float64)


def _spread(seen: FloatArray, extremes: FloatArray) -> FloatArray:
    """Points for the LMI: some along the trajectories, and the extremes of the box."""
    some = seen[np.linspace(0, len(seen) - 1, min(len(seen), LYAPUNOV_POINTS)).astype(int)]
    return np.unique(np.concatenate([some, extremes[:: max(1, len(extremes) // 16)]]), axis=0)


def _stress(
    system: _Neural | _Linear,
    worst: FloatArray,
    low: FloatArray,
    high: FloatArray,
    y0: FloatArray,
    x0: FloatArray,
    steps: int,
) -> tuple[Stress, ...]:
    """Long runs under all inputs side by side, in pieces, from x(0) with y(0) before it."""
    random = named_random(0, "stress")
    middle, half = (high + low) / 2, (high - low) / 2
    b = len(INPUTS)
    previous = np.repeat(np.asarray(y0, dtype=float)[:, None], b, axis=1)
    state = np.repeat(x0[:, None], b, axis=1)
    largest_x, largest_y, reached = np.zeros(b), np.zeros(b), np.zeros(b, dtype=int)
    for begin in range(0, steps, CHUNK):
        k = np.arange(begin, min(begin + CHUNK, steps))
        unit = np.zeros((len(k), len(low), b))
        unit[:, :, 1], unit[:, :, 2] = 1.0, -1.0
        unit[:, :, 3] = random.uniform(-1, 1, (len(k), len(low)))
        phase = k % 10_000  # a sweep from 0 to half the sampling rate
        unit[:, :, 4] = np.sin(np.pi * phase**2 / 20_000)[:, None]
        unit[:, :, 5] = np.where(k // 50 % 2 == 0, 1.0, -1.0)[:, None]
        u = middle[:, None] + half[:, None] * unit
        u[:, :, 0] = 0.0
        u[:, :, 6] = worst[k % len(worst)]
        u[:, :, 7] = worst[np.minimum(k, len(worst) - 1)]
        with np.errstate(over="ignore", invalid="ignore"):
            y, x = system.run(u, previous, state)
            norms, outputs = np.linalg.norm(x, axis=1), np.abs(y).max(axis=1)
        finite = np.isfinite(norms) & np.isfinite(outputs)
        alive = finite.cumprod(axis=0).astype(bool)
        reached += alive.sum(axis=0)
        largest_x = np.maximum(largest_x, np.where(alive, norms, 0).max(axis=0))
        largest_y = np.maximum(largest_y, np.where(alive, outputs, 0).max(axis=0))
        largest_x, largest_y = (np.where(finite.all(axis=0), largest, np.inf) for largest in (largest_x, largest_y))
        state = system.next_state(x[-1], u[-1], y[-2] if len(y) > 1 else previous)
        previous = y[-1]
    return tuple(Stress(INPUTS[i], int(reached[i]), float(largest_x[i]), float(largest_y[i])) for i in range(b))


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
