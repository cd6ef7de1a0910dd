"""The largest ρ(A) and ‖A‖ over a box around the scheduling points seen: sampled, then gradient ascent."""

from __future__ import annotations

import math

import numpy as np
import torch

from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate.systems import Linear, Neural, radii
from nnss_cli.iterative import named_random

SAMPLES = 4096  # points of the box
CLIMBERS, CLIMBS = 32, 60  # gradient ascent in the box: starts and steps
WIDER = 0.5  # the box is the range of the trajectories, wider by this share on either side
LYAPUNOV_POINTS = 150


def over_box(system: Neural | Linear, seen: FloatArray) -> tuple[float, float, FloatArray]:
    """Largest ρ(A) and ‖A‖₂ over a box around the ρ seen, and the points where they were found."""
    low, high = seen.min(axis=0), seen.max(axis=0)
    low, high = low - WIDER * (high - low), high + WIDER * (high - low)
    rho = named_random(0, "box").uniform(low, high, (SAMPLES, seen.shape[1]))
    A = system.matrices(rho)
    largest = []
    extremes = []
    for measure in (radii, lambda A: np.linalg.norm(A, 2, axis=(1, 2))):
        values = measure(A)
        starts = rho[np.argsort(-values)[:CLIMBERS]]
        ends = _climb(system, starts, low, high, measure is radii)
        largest.append(float(max(values.max(), measure(system.matrices(ends)).max())))
        extremes.append(ends)
    return largest[0], largest[1], np.concatenate(extremes)


def _climb(system: Neural | Linear, starts: FloatArray, low: FloatArray, high: FloatArray, radius: bool) -> FloatArray:
    """Projected gradient ascent of ρ(A) or ‖A‖₂ inside the box."""
    if isinstance(system, Linear):
        return starts
    model = system.examined
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


def spread(seen: FloatArray, extremes: FloatArray) -> FloatArray:
    """Points for the LMI: some along the trajectories, and the extremes of the box."""
    some = seen[np.linspace(0, len(seen) - 1, min(len(seen), LYAPUNOV_POINTS)).astype(int)]
    return np.unique(np.concatenate([some, extremes[:: max(1, len(extremes) // 16)]]), axis=0)
