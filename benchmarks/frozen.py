"""Frozen A(x) beside the linearisation of a trained model, along its equilibria: docs/frozen.png.

    python benchmarks/frozen.py results/twotank/paper/runs/nnss-n3-s0 --at 5 --out docs/frozen.png

One input and one output. Prints both DC gains at the operating point and the slope of the static curve there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from nnss_cli.machine import prepare

prepare()

import numpy as np

import nnss_cli as nnss
from nnss_cli.report.figures import plt, save_figure
from nnss_cli.report.style import STYLE
from nnss_cli.trained.linear import Frozen


def dc_gain(frozen: Frozen) -> float:
    """C (I − A)⁻¹ B + D of frozen matrices."""
    return float((frozen.C @ np.linalg.solve(np.eye(len(frozen.A)) - frozen.A, frozen.B) + frozen.D)[0, 0])


def gains(model: nnss.TrainedModel, u: float, h: float = 1e-3) -> tuple[float, float, float]:
    """DC gain frozen at the equilibrium under u, that of the linearisation there, and the static curve's slope."""
    at = model.equilibrium(u)
    slope = (model.equilibrium(u + h).y - model.equilibrium(u - h).y) / (2 * h)
    n = model.system.n
    return dc_gain(model.matrices(at.z[:n], u=at.u)), float(model.linearise(u).dcgain().item()), float(slope[0])


def step_responses(model: nnss.TrainedModel, u: float, K: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outputs after a small step of the input, per unit of it: of the model, its linearisation, frozen matrices."""
    at, size = model.equilibrium(u), 0.05
    n = model.system.n
    moved = (model.simulate(np.full(K, u + size), x0=at.z).y[:, 0] - at.y[0]) / size
    f, linear = model.matrices(at.z[:n], u=at.u), model.linearise(u)
    found = []
    for A, B, C, D in ((linear.A, linear.B, linear.C, linear.D), (f.A, f.B, f.C, f.D)):
        x, y = np.zeros(len(A)), []
        for _ in range(K):
            y.append((C @ x + D[:, 0])[0])
            x = A @ x + B[:, 0]
        found.append(np.array(y))
    return moved, found[0], found[1]


def main() -> None:
    """Compute, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--at", type=float, required=True, help="operating point of the input")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    model = nnss.load(given.model)
    frozen, linear, slope = gains(model, given.at)
    print(f"u = {given.at:g}: DC gain {frozen:.4f} frozen, {linear:.4f} linearised, {slope:.4f} by the static curve")
    seen = np.concatenate([record.u for record in model.records()["train"]])
    points = np.linspace(*np.quantile(seen, [0.02, 0.98]), 25)
    table = np.array([gains(model, float(u)) for u in points])
    moved, by_jacobian, by_frozen = step_responses(model, given.at, K := 600)
    unit = f"{model.channels.output_units[0]}/{model.channels.input_units[0]}"
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained")
        looks = (("#D55E00", "--", "frozen A(x), B(x), C(x)"), ("#0072B2", "-", "linearisation"))
        for values, (colour, line, label) in zip(table.T, looks, strict=False):
            left.plot(points, values, color=colour, linestyle=line, label=label)
        left.plot(points, table[:, 2], "o", color="black", markersize=3, label="static curve's slope")
        left.axvline(given.at, color="0.8", zorder=0)
        left.set_xlabel(f"{model.channels.inputs[0]} at rest [{model.channels.input_units[0]}]")
        left.set_ylabel(f"DC gain [{unit}]")
        t = np.arange(K) * model.Ts
        right.plot(t, by_frozen, color="#D55E00", linestyle="--")
        right.plot(t, moved, color="black", linewidth=2.2, alpha=0.35, label="the model, 0.05 up")
        right.plot(t, by_jacobian, color="#0072B2")
        right.set_xlabel("time [s]")
        right.set_ylabel(f"step response at {given.at:g} {model.channels.input_units[0]} [{unit}]")
        handles, labels = (a + b for a, b in zip(*(p.get_legend_handles_labels() for p in (left, right)), strict=True))
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8)
    save_figure(figure, given.out)


if __name__ == "__main__":
    main()
