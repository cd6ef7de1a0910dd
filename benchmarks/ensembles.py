"""Rules of an ensemble on drawn records: errors against outputs without noise, some under inputs unlike the training's.

    python benchmarks/ensembles.py [--records 6] [--seeds 10]

Plants: the two tanks of twotank-sim (order 3; 1500 samples train, 500 validate, 6000 test, whose input has levels that
the others lack); two tanks that overflow (order 2; 864, 160, 2 × 1024); a hardening spring (order 2; 1100, 400, 3000).
"""

from nnss_cli.machine import prepare

prepare()

import argparse
import math
from collections.abc import Callable

import numpy as np
from nnss_cli.datasets.catalog.simulated import NOISE, draw
from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Record, Scaling, unscored
from tabulate import tabulate

from nnss_cli.methods import METHODS, Model
from nnss_cli.methods.ensemble import better_half
from nnss_cli.model.ensemble import Ensemble

Drawn = tuple[FittingData, list[Record]]
"""What is fitted, and test records without noise."""


def two_tanks(number: int) -> Drawn:
    random = np.random.default_rng(1000 + number)
    u, level = draw(random, 8000)
    measured = level + NOISE * random.standard_normal(len(u))
    train, val = (Record(u[part, None], measured[part, None], 0.2) for part in (slice(1500), slice(1500, 2000)))
    return fitting(train, val, 1), [Record(u[2000:, None], level[2000:, None], 0.2)]


def overflow(number: int) -> Drawn:
    """ẋ1 = 0.144 u − 0.16 √x1, ẋ2 = 0.16 √x1 − 0.17 √x2: x1 runs over at 9, two fifths of it into x2, and x2 at 10."""
    random = np.random.default_rng(2000 + number)

    def record() -> tuple[FloatArray, FloatArray]:
        spectrum = np.zeros(513, complex)
        spectrum[1:20] = np.exp(2j * np.pi * random.random(19))
        u = np.fft.irfft(spectrum, 1024)
        u = np.clip(u / u.std(), -2.5, 2.5) * 1.2 + 3.5
        x1, x2 = 2.0 + random.random(), 4 + random.random()
        y = np.empty(len(u))
        for k, volts in enumerate(u.tolist()):
            y[k] = min(x2, 10.0)
            for _ in range(10):
                q1, q2 = 0.16 * math.sqrt(max(x1, 0)), 0.17 * math.sqrt(max(x2, 0))
                filled = x1 + 0.1 * (0.144 * volts - q1)
                x1, x2 = min(filled, 9.0), min(x2 + 0.1 * (q1 - q2) + 0.4 * max(filled - 9.0, 0), 10.0)
        return u[:, None], y[:, None]

    (u, y), *tests = (record() for _ in range(3))
    measured = y + 0.02 * random.standard_normal(y.shape)
    data = fitting(Record(u[160:], measured[160:], 4.0), Record(u[:160], measured[:160], 4.0), 50)
    return data, [Record(*test, 4.0) for test in tests]


def spring(number: int) -> Drawn:
    """ẍ = u − 0.15 ẋ − x − 3 x³ under filtered noise, 2 % of a deviation on y."""
    random = np.random.default_rng(4000 + number)

    def record(K: int) -> tuple[FloatArray, FloatArray]:
        u = np.convolve(random.standard_normal(K), np.ones(4) / 4, "same")
        x = v = 0.0
        y = np.empty(K)
        for k, force in enumerate(u.tolist()):
            y[k] = x
            for _ in range(10):
                v += 0.05 * (force - 0.15 * v - x - 3 * x**3)
                x += 0.05 * v
        return u[:, None], y[:, None]

    (u, y), test = record(1500), record(3000)
    measured = y + 0.02 * y.std() * random.standard_normal(y.shape)
    data = fitting(Record(u[:1100], measured[:1100], 0.5), Record(u[1100:], measured[1100:], 0.5), 20)
    return data, [Record(*test, 0.5)]


PLANTS: dict[str, tuple[Callable[[int], Drawn], int]] = {
    "two tanks": (two_tanks, 3), "tanks with overflow": (overflow, 2), "hardening spring": (spring, 2),
}  # fmt: skip
"""What draws a record, and the order that is fitted."""


def fitting(train: Record, val: Record, init_window: int) -> FittingData:
    channels = Channels(("u",), ("y",), ("",), ("",))
    return FittingData("drawn", "own", (train,), (val,), Scaling.of((train,)), channels, init_window)


def error(model: Model, tests: list[Record], data: FittingData) -> float:
    """RMSE over the test records after the init window, /σ of the training outputs."""
    w = data.init_window
    begin = unscored(w)
    off = [(model.simulate(test.u, test.y[:w]).y - test.y)[begin:] for test in tests]
    return float(np.sqrt(np.mean(np.square(np.concatenate(off)))) / data.scaling.y_std[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=6)
    parser.add_argument("--seeds", type=int, default=10)
    given = parser.parse_args()
    if given.seeds < 5:
        parser.error("--seeds: expected 5 or more, of whose better half three are left")
    method, rows, ratios = METHODS["nnss"], [], []
    for name, (drawn, order) in PLANTS.items():
        found = []
        for number in range(given.records):
            data, tests = drawn(number)
            settings = method.settings(data, order, {})
            method.prepare(settings)
            fits = [method.fit(data, order, seed, settings, None) for seed in range(given.seeds)]
            models = [fit.model for fit in fits if fit.model]
            if len(models) < given.seeds:
                print(f"{name} {number}: {given.seeds - len(models)} of {given.seeds} seeds gave no model", flush=True)
                continue
            members = better_half(models, data)
            errors = [
                float(np.median([error(model, tests, data) for model in models])),
                error(members[0], tests, data),
                *(error(Ensemble(members, rule), tests, data) for rule in ("mean", "clipped")),
            ]
            found.append(errors)
            rows.append([f"{name} {number}", *(f"{each:.3f}" for each in errors)])
            print(*rows[-1], sep="  ", flush=True)
        relative = np.array(found)[:, 1:] / np.array(found)[:, :1]
        spans = zip(np.exp(np.log(relative).mean(axis=0)), relative.max(axis=0), strict=True)
        ratios.append([name, *(f"{mean:.2f} ({worst:.2f})" for mean, worst in spans)])
    print(f"\nRMSE/σ, {given.seeds} seeds")
    heads = ["median seed", "best on validation", "mean", "clipped"]
    print(tabulate(rows, headers=["record", *heads], tablefmt="pipe", disable_numparse=True))
    print("\nOver the median seed's: geometric mean over records (the worst)")
    print(tabulate(ratios, headers=["plant", *heads[1:]], tablefmt="pipe", disable_numparse=True))


if __name__ == "__main__":
    main()
