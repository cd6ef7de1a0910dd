"""The gain K of a predictor, from the residuals on the training records; validation chooses among candidates.

Candidates, the simplest first:

1. K = 0: the simulation.
2. Kalman gains of the mean Jacobians F, H on the training trajectory: P = F P Fᵀ + Q − K (H P Hᵀ + R) Kᵀ,
   K = F P Hᵀ (H P Hᵀ + R)⁻¹ with R the covariance of the simulation's residuals and Q = q R_z, R_z that of the states
   or of their increments, for a range of q. The one with the smallest one-step errors on train stands for them.
3. From there, the K that minimises the one-step errors on train, which for Gaussian errors is the maximum of the
   likelihood. Along a trajectory ẑ of the predictor, another K̃ = K + δ moves the predictor by ξ,

       ξ(k+1) = F(k) ξ(k) + K̃ ε̃(k) − K ε(k),   ε̃(k) = ε(k) − H(k) ξ(k)

   to first order, and Levenberg–Marquardt minimises Σ ε̃ᵀ Λ⁻¹ ε̃ by K̃; then F, H and Λ are taken anew.
4. The same with a disturbance of each output that the gain lets follow the errors, of increments with covariance q_d R:
   for where the model is off by an amount that hardly varies. One for each of a range of q_d, since what disturbs a
   model where it was not trained cannot be seen on train.
5. Where none of these beats persistence, ŷ(k) = y(k−1), on validation, in every output: increments of the outputs from
   those of inputs and past outputs (`nnss_cli.validation.disturbance`), 0 to 3 lags, without or with the model's.
   Without, it has no part in the prediction, and `predict` says so. `validate` fails a model that needs either.

A candidate whose observer δẑ(k+1) = (F(k) − K H(k)) δẑ(k) does not contract along the trajectories of training
and validation is left out; of the others the simplest within 2 % of the lowest one-step error on validation is taken.
Of long records these are the parts where the inputs vary most; the one taken must err no more than K = 0 over each of
them from end to end, or the next one is taken: an observer may contract on its way and be lost all the same.

Source for 2 and 3: L. Ljung, "System Identification", 2nd ed., 1999, sections 4.3 and 7.4; for 4: K. R. Muske and
T. A. Badgwell, "Disturbance modeling for offset-free linear model predictive control", J. Process Control 12, 2002.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import scipy.linalg

from nnss_cli.baselines.subspace import inverse_root
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_dynamics import excerpt
from nnss_cli.training.least_squares import NormalEquations, levenberg_marquardt
from nnss_cli.validation import gain_kernels as kernels
from nnss_cli.validation.disturbance import Disturbance, Increments, constant
from nnss_cli.validation.predictor import Predictor, step_table
from nnss_cli.validation.stepping import Stepper

Found: TypeAlias = list[tuple[Disturbance | None, dict[str, FloatArray]]]
"""Disturbances, and by name the gains that are candidates with each."""

SAMPLES = 4096  # of train, and of validation, that are looked at: where the inputs vary most
PIECE = 256  # samples of a piece of train; the pieces run side by side
RATIOS = np.geomspace(1e-6, 1e4, 8)  # q
LAGS = range(4)
INCREMENTS = "increments"
ALONE = "increments alone"
"""The origin of a gain that corrects a regression in which the model has no part."""
DISTURBANCES = 0.01, 0.1, 1.0, 10.0, 100.0  # q_d
ROUNDS = 2
ITERATIONS = 25
MARGIN = (
    1.02  # a candidate is good enough when its validation error is within 2 % of the lowest: the first such is taken
)
ENOUGH = 1e-5  # relative decrease of the squares below which a round ends


@dataclass(frozen=True, eq=False)
class Gain:
    """The gain of one system, and how it was come by."""

    K: FloatArray
    """(s, m), normalised units."""
    origin: str
    """Which candidate validation took: "none" (K = 0), "Kalman", "least one-step error", one with disturbance,
    `INCREMENTS`, or `ALONE`."""
    rate: float
    """Growth a sample of δẑ(k+1) = (F(k) − K H(k)) δẑ(k) over the training or validation
    record where it is largest, below 1 for a stable observer."""
    radius: float
    """Largest spectral radius of F(k) − K H(k) along these records; above 1 at times, rate may be below 1."""
    val: dict[str, float]
    """One-step RMSE on validation by candidate, normalised units, geometric mean over the outputs."""
    disturbance: Disturbance | None = None
    """What the outputs have beside the model's own, where K corrects that, too."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A gain, and what came of it on validation and training."""

    name: str
    error: float  # one step ahead on validation
    system: Stepper  # with the disturbance
    by: Disturbance | None
    K: FloatArray
    rate: float
    radius: float


@dataclass(frozen=True, eq=False)
class _Pieces:
    """Contiguous pieces of the training records, side by side."""

    u: FloatArray  # (L, b, r)
    y: FloatArray  # (L, b, m)
    start: FloatArray  # (b, s)
    scored: FloatArray  # (L, b): 1, or 0 while a start is forgotten
    follows: FloatArray  # (b,): whether a piece continues the one before it


@dataclass(frozen=True, eq=False)
class _Line:
    """The predictor with K along its own trajectory, linearised."""

    K: FloatArray
    F: FloatArray  # (L, b, s, s)
    H: FloatArray  # (L, b, m, s)
    z: FloatArray  # (L + 1, b, s)
    errors: FloatArray  # (L, b, m)
    weight: FloatArray  # (m, m), Λ^(−1/2)


def estimate_gain(system: Stepper, train: Sequence[Record], val: Sequence[Record], init_window: int = 1) -> Gain:
    """K of a system.

    Args:
        system: the model's step.
        train: records to fit on, physical units.
        val: records to choose on, physical units.
        init_window: first output samples that tell x(0) of a record.
    """
    none = {"none": np.zeros((system.size, system.outputs))}
    plain = none | _candidates(system, train, init_window, (0.0,))
    by = constant(train[0].input_count, system.outputs)
    found: Found = [(None, plain), (by, _candidates(system.disturbed(by), train, init_window, DISTURBANCES))]
    judged = _judged(system, found, train, val, init_window)
    gain = _chosen(judged, train, val, init_window)
    if _beats_persistence(system, gain, val, init_window):
        return gain
    judged += _judged(system, _of_increments(system, train, init_window), train, val, init_window)
    return _chosen(judged, train, val, init_window)


def _beats_persistence(system: Stepper, gain: Gain, records: Sequence[Record], w: int) -> bool:
    """Whether its one-step errors over the records are smaller than those of y(k−1), in every output."""
    predictor = Predictor(system.model, (gain.K,), (gain.disturbance,))
    try:
        table = step_table(predictor, _stretches(records, records[0].input_count), (1,), w)
    except InputError:  # it leaves the range of numbers
        return False
    return bool((table.predicted < table.persistence).all())


def _of_increments(system: Stepper, train: Sequence[Record], w: int) -> Found:
    """The candidates with increments, by number of lags."""
    u = [system.scaling.normalise_u(record.u) for record in train]
    y = [system.scaling.normalise_y(record.y) for record in train]
    h = [system.scaling.normalise_y(system.simulate(record.u, record.y[:w]).y) for record in train]
    found: Found = []
    for lags, alone in itertools.product(LAGS, (True, False)):
        increments = Increments.fitted(u, y, h, lags, alone)
        if increments is not None:
            by, K = increments.disturbance()
            own = np.zeros((system.size, system.outputs))
            found.append((by, {f"{ALONE if alone else INCREMENTS}, {lags} lags": np.concatenate([own, K])}))
    return found


def _candidates(
    system: Stepper, train: Sequence[Record], w: int, disturbances: Sequence[float]
) -> dict[str, FloatArray]:
    """Kalman gains, one for each q_d, and what refinement makes of the one with the smallest errors on train."""
    pieces = _cut(system, train, w)
    line = _linearise(system, np.zeros((system.size, system.outputs)), pieces)
    if line is None:
        return {}
    found: dict[str, FloatArray] = {}
    least, K = np.inf, line.K
    for q_d in disturbances:
        squares, gain = _kalman(line, pieces, system, q_d)
        if gain is not None:
            found["Kalman" if q_d == 0 else f"Kalman with disturbance, q_d = {q_d:g}"] = gain
            least, K = min((least, K), (squares, gain), key=lambda pair: pair[0])
    if not found:
        return {}
    what = "least one-step error" if disturbances == (0.0,) else "least one-step error with disturbance"
    for round_ in range(ROUNDS):
        pieces = _restarted(system, K, pieces)
        line = _linearise(system, K, pieces)
        if line is None:
            break
        K = _refined(line, pieces)
        found[f"{what}, round {round_ + 1}"] = K
    return found


def _stretches(records: Sequence[Record], inputs: int) -> list[Record]:
    parts = excerpt([np.concatenate([record.u, record.y], axis=1) for record in records], SAMPLES, inputs)
    kept = [Record(part[:, :inputs], part[:, inputs:], records[0].Ts) for part in parts]
    return kept or list(records)


def _begin(system: Stepper, record: Record, w: int) -> FloatArray:
    known = record[: min(w, len(record))]
    x0 = system.model.simulate(known.u, known.y).x[0]
    return system.start(x0, system.scaling.normalise_y(record.y[0]), system.scaling.normalise_u(record.u[0]))


def _cut(system: Stepper, train: Sequence[Record], w: int) -> _Pieces:
    """Pieces of one length; what a record has beyond a whole number of them is left out."""
    records = _stretches(train, train[0].input_count)
    L = min(len(record) // max(1, round(len(record) / PIECE)) for record in records)
    cut = [(record[at : at + L], at == 0) for record in records for at in range(0, len(record) - L + 1, L)]
    scored = np.ones((L, len(cut)))
    for b, (_, first) in enumerate(cut):
        scored[: min(w if first else L // 8, L // 2), b] = 0
    scaled = [system.scaling.apply(piece) for piece, _ in cut]
    return _Pieces(
        np.stack([piece.u for piece in scaled], axis=1),
        np.stack([piece.y for piece in scaled], axis=1),
        np.stack([_begin(system, piece, w if first else system.sees) for piece, first in cut]),
        scored,
        np.array([not first for _, first in cut]),
    )


def _restarted(system: Stepper, K: FloatArray, pieces: _Pieces) -> _Pieces:
    """Each piece that continues another begins where that one's predictor ends."""
    z, _ = system.observe(np.repeat(K[None], len(pieces.start), axis=0), pieces.start, pieces.u, pieces.y)
    end = np.roll(z[-1], 1, axis=0)
    moved = pieces.follows & np.isfinite(end).all(axis=1)
    start = np.where(moved[:, None], end, pieces.start)
    return _Pieces(pieces.u, pieces.y, start, pieces.scored, pieces.follows)


def _linearise(system: Stepper, K: FloatArray, pieces: _Pieces) -> _Line | None:
    """None where the predictor leaves the range of numbers, or foresees everything."""
    L, b = pieces.u.shape[:2]
    z, predicted = system.observe(np.repeat(K[None], b, axis=0), pieces.start, pieces.u, pieces.y)
    if not (np.isfinite(z).all() and np.isfinite(predicted).all()):
        return None
    F, H = system.jacobians(z[:-1].reshape(L * b, -1), pieces.u.reshape(L * b, -1))
    errors = pieces.y - predicted
    weight = inverse_root(errors[pieces.scored > 0])
    if weight is None:
        return None
    return _Line(K, F.reshape(L, b, *F.shape[1:]), H.reshape(L, b, *H.shape[1:]), z, errors, weight)


def _errors(line: _Line, K: FloatArray) -> tuple[FloatArray, FloatArray]:
    """ε̃ (L, b, m) of another gain, to first order, and its derivatives (L, b, m, s·m) by that gain's entries.

    ξ = z̃ − z obeys ξ(k+1) = (F − K H) ξ + (K − K₀) ε, with K₀ the line's own.
    """
    L, b, m = line.errors.shape
    errors, J = np.empty((L, b, m)), np.empty((L, b, m, len(K), m))
    with np.errstate(over="ignore", invalid="ignore"):
        driven = line.errors @ (K - line.K).T
        kernels.sensitivities(line.F - K @ line.H, line.H, driven, line.errors, errors, J)
    return errors, J.reshape(L, b, m, -1)


def _squares(line: _Line, pieces: _Pieces, K: FloatArray) -> FloatArray:
    """Σ ε̃ᵀ Λ⁻¹ ε̃ of other gains K (c, s, m), side by side, to first order (c,); infinite where one diverges."""
    L, b, _ = line.errors.shape
    xi, total = np.zeros((len(K), b, K.shape[1], 1)), np.zeros(len(K))
    known = (line.errors @ line.K.T)[..., None]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(L):
            error = line.errors[k][..., None] - line.H[k] @ xi  # (c, b, m, 1)
            total += np.sum(np.square(line.weight @ error)[..., 0] * pieces.scored[k][:, None], axis=(1, 2))
            xi = line.F[k] @ xi + K[:, None] @ error - known[k]
    return np.where(np.isfinite(total), total, np.inf)


def _kalman(line: _Line, pieces: _Pieces, system: Stepper, q_d: float) -> tuple[float, FloatArray | None]:
    """The best of a range of Kalman gains by the one-step errors on train, after their squares; None without any.

    The line is that of the simulation, K = 0.
    """
    F, H = line.F.mean(axis=(0, 1)), line.H.mean(axis=(0, 1))
    R = np.atleast_2d(np.cov(line.errors[pieces.scored > 0].T))
    R = R + 1e-9 * np.trace(R) * np.eye(len(R))
    own = system.size - system.outputs * (q_d > 0)
    found = []
    for moved in (line.z, np.diff(line.z, axis=0)):
        shape = np.atleast_2d(np.cov(moved[..., :own].reshape(-1, own).T))
        for q in RATIOS:
            Q = q * shape + 1e-12 * np.trace(shape) * np.eye(own)
            if q_d > 0:
                Q = scipy.linalg.block_diag(Q, q_d * R)
            try:
                P = scipy.linalg.solve_discrete_are(F.T, H.T, Q, R)
                found.append(np.linalg.solve(H @ P @ H.T + R, H @ P @ F.T).T)
            except (np.linalg.LinAlgError, ValueError):
                continue
    if not found:
        return np.inf, None
    squares = _squares(line, pieces, np.stack(found))
    best = int(np.argmin(squares))
    return float(squares[best]), found[best] if np.isfinite(squares[best]) else None


def _refined(line: _Line, pieces: _Pieces) -> FloatArray:
    """The K of the smallest one-step errors on train that Levenberg–Marquardt reaches from the line's own."""
    best, last = line.K, np.inf

    F, H = line.F.mean(axis=(0, 1)), line.H.mean(axis=(0, 1))

    def evaluate(point: FloatArray) -> tuple[NormalEquations, FloatArray]:
        K = point.reshape(line.K.shape)
        errors, J = _errors(line, K)
        if not np.isfinite(J).all() or np.abs(np.linalg.eigvals(F - K @ H)).max() >= 1:
            return NormalEquations(np.eye(len(point)), np.zeros(len(point)), np.inf, 1), point
        weighted = (errors @ line.weight.T) * pieces.scored[..., None]
        J = (line.weight @ J) * pieces.scored[..., None, None]
        return NormalEquations.of(weighted.ravel(), J.reshape(-1, J.shape[-1])), point

    def accepted(point: FloatArray, squares: float, _: FloatArray) -> bool:
        nonlocal best, last
        best, goes_on = point.reshape(line.K.shape), squares < (1 - ENOUGH) * last
        last = squares
        return goes_on

    levenberg_marquardt(evaluate, line.K.ravel(), ITERATIONS, accepted)
    return best


def _judged(system: Stepper, found: Found, train: Sequence[Record], val: Sequence[Record], w: int) -> list[_Candidate]:
    """Each candidate with what its observer does along training and validation."""
    records, known = _stretches(val, val[0].input_count), _stretches(train, train[0].input_count)
    judged = []
    for by, candidates in found:
        whole = system if by is None else system.disturbed(by)
        if candidates:
            K = np.stack(list(candidates.values()))
            errors, paths = _judge(whole, K, records, w)
            paths += _judge(whole, K, known, w)[1]
            rates, radii = _contraction(whole, K, paths)
            judged += [
                _Candidate(name, float(errors[i]), whole, by, K[i], float(rates[i]), float(radii[i]))
                for i, name in enumerate(candidates)
            ]
    return judged


def _chosen(judged: Sequence[_Candidate], train: Sequence[Record], val: Sequence[Record], w: int) -> Gain:
    """The candidate with the smallest one-step errors on validation whose observer contracts there and on train."""
    stable = [each for each in judged if each.rate < 1 or each.name == "none"]
    lowest = min(each.error for each in stable)  # K = 0 is among them
    # good ones as they come, the simplest first, then the others by their errors
    stable.sort(key=lambda each: 0 if each.error <= MARGIN * lowest or not np.isfinite(lowest) else each.error)
    long = [record for records in (train, val) if sum(map(len, records)) > SAMPLES for record in records]
    best = next(each for each in stable if each.name == "none" or _serves(each.system, each.K, long, w))
    errors = {each.name: each.error for each in judged}
    return Gain(best.K, best.name.split(",")[0], best.rate, best.radius, errors, best.by)


def _serves(system: Stepper, K: FloatArray, records: Sequence[Record], w: int) -> bool:
    """Whether K errs no more than none over each of the records, of which candidates saw the liveliest parts alone."""
    both = np.stack([np.zeros_like(K), K])
    errors = (_judge(system, both, [record], w)[0] for record in records)
    return all(own <= none and np.isfinite(own) for none, own in errors)


def _judge(
    system: Stepper, K: FloatArray, records: Sequence[Record], w: int
) -> tuple[FloatArray, list[tuple[FloatArray, FloatArray]]]:
    """One-step RMSE of gains (c, s, m), the geometric mean over outputs (c,), and ẑ (N, c, s) with u of each record."""
    squares, count, paths = np.zeros((len(K), system.outputs)), 0, []
    for record in records:
        scaled = system.scaling.apply(record)
        z0 = np.repeat(_begin(system, record, w)[None], len(K), axis=0)
        u, y = (np.repeat(signal[:, None], len(K), axis=1) for signal in (scaled.u, scaled.y))
        z, predicted = system.observe(K, z0, u, y)
        begin = min(w, len(record) - 1)
        with np.errstate(over="ignore", invalid="ignore"):
            squares += np.square(y - predicted)[begin:].sum(axis=0)
        count += len(record) - begin
        paths.append((z[:-1], scaled.u))
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.exp(np.mean(np.log(np.sqrt(squares / count)), axis=1))
    return np.where(np.isfinite(errors), errors, np.inf), paths


def growth_along(system: Stepper, found: Gain, records: Sequence[Record], w: int) -> float:
    """Growth a sample of the observer's error over the record where it is largest; see `Gain.rate`.

    Args:
        system: without disturbance.
        found: its gain.
        records: experiments, physical units.
        w: first samples that tell x(0).
    """
    whole = system if found.disturbance is None else system.disturbed(found.disturbance)
    _, paths = _judge(whole, found.K[None], records, w)
    return float(_contraction(whole, found.K[None], paths)[0][0])


def _contraction(
    system: Stepper, K: FloatArray, paths: Sequence[tuple[FloatArray, FloatArray]]
) -> tuple[FloatArray, FloatArray]:
    """Growth a sample of the observers' errors, to first order, over the record where each grows most; largest radii.

    The radius is the largest spectral radius of a frozen F(k) − K H(k); both are infinite where a path is not finite.

    Args:
        system: with the disturbance.
        K: gains (c, s, m).
        paths: of each record ẑ (N, c, s) and u (N, r).
    """
    rates, radii = np.zeros((2, len(K)))
    for z, u in paths:
        finite = np.isfinite(z).all(axis=(0, 2))
        rates[~finite] = radii[~finite] = np.inf
        path = z[:, finite]
        N, c, s = path.shape
        if c == 0:
            break
        F, H = system.jacobians(path.reshape(N * c, s), np.repeat(u, c, axis=0))
        closed = F.reshape(N, c, s, s) - K[finite] @ H.reshape(N, c, -1, s)
        radii[finite] = np.maximum(radii[finite], np.abs(np.linalg.eigvals(closed)).max(axis=(0, 2)))
        product, growth = np.broadcast_to(np.eye(s), (c, s, s)), np.zeros(c)
        with np.errstate(divide="ignore"):  # a dead beat: the logarithm of 0
            for step in closed:
                product = step @ product
                size = np.sqrt(np.einsum("cij,cij->c", product, product))
                growth += np.log(size)
                product = product / np.where(size > 0, size, 1)[:, None, None]
        growth -= 0.5 * np.log(s)  # the norm that the identity began with
        rates[finite] = np.maximum(rates[finite], np.exp(growth / N))
    return rates, radii
