"""Training engines: milliseconds per optimiser step, as ratios to the plain reference in one run, one core.

    make bench        (or: python benchmarks/training.py [--jax] [--torch-compile])

The fraction of the GEMM limit is the step's matrix-product work over what one core does on large
matrices of the same precision. JAX (lax.scan under jit) and torch.compile (of one sample's step)
are other ways to speed up the plain loop; they are timed where asked for and installed.
"""

from nnss_cli.machine import prepare

prepare()

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import torch
from nnss_cli.baselines.simba import initial_parameters, loss_and_gradient
from nnss_cli.datasets.record import Channels, FloatArray, Scaling
from tabulate import tabulate

from nnss_cli.iterative import named_random
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.model.schur import schur_matrix
from nnss_cli.training.engine import ReferenceEngine, training_loss
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.recipe import Recipe


@dataclass(frozen=True)
class Setting:
    """One row of the table."""

    name: str
    n: int
    r: int
    m: int
    hidden: tuple[int, ...]
    encoder: tuple[int, ...]
    L: int
    batch: int
    target: dict[str, float]


SETTINGS = [
    Setting("two-tank", 3, 1, 1, (100, 100), (16, 16), 80, 64, {"float32": 8, "float64": 5}),
    Setting("robot arm", 5, 1, 1, (150,) * 4, (64,) * 4, 100, 32, {"float32": 4, "float64": 3}),
    Setting("power plant", 4, 5, 3, (120,) * 5, (64,) * 4, 100, 1, {"float32": 40, "float64": 25}),
]


def model_of(s: Setting, dtype: str, stability: str = "schur") -> NNSS:
    scaling = Scaling(np.zeros(s.r), np.ones(s.r), np.zeros(s.m), np.ones(s.m))
    channels = Channels(("u",) * s.r, ("y",) * s.m, ("",) * s.r, ("",) * s.m)
    hidden = s.hidden[:1] if stability == "incremental" else s.hidden  # it has one layer
    architecture = Architecture(s.n, s.r, s.m, hidden, s.encoder, dtype=dtype, stability=stability)
    model = NNSS(architecture, scaling, channels, 1.0)
    model.initialise(named_random(0, "weights"))
    return model


def milliseconds(step: Callable[[], object], seconds: float = 3.0) -> float:
    """Median time of a step after a warm-up."""
    step()
    times = []
    until = time.perf_counter() + seconds
    while time.perf_counter() < until or len(times) < 5:
        times.append(milliseconds_once(step))
    return float(np.median(times))


def milliseconds_once(step: Callable[[], object]) -> float:
    """Time of one step."""
    started = time.perf_counter()
    step()
    return 1e3 * (time.perf_counter() - started)


def side_by_side(steps: Iterable[Callable[[], object]], seconds: float = 3.0) -> list[float]:
    """Median time of each of some steps, taken in turn, so that what else the machine does meets all."""
    rounds, until, together = [], time.perf_counter() + seconds, list(steps)
    while time.perf_counter() < until or len(rounds) < 6:
        rounds.append([milliseconds_once(step) for step in together])
    return [float(each) for each in np.median(rounds[1:], axis=0)]


def gemm_rate(dtype: str) -> float:
    """Floating-point operations per second of large matrix products: NumPy's BLAS or torch's, the faster."""
    A = np.random.default_rng(0).standard_normal((768, 768)).astype(dtype)
    T = torch.from_numpy(A)
    return 2 * 768**3 / (min(milliseconds(lambda: A @ A, 1.0), milliseconds(lambda: T @ T, 1.0)) * 1e-3)


def jax_step(s: Setting, dtype: str, u: FloatArray, y: FloatArray) -> Callable[[], object]:
    """The same loss and Adam in JAX: lax.scan over the samples, all under jit."""
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", dtype == "float64")
    model = model_of(s, dtype)
    parameters = [jnp.asarray(p.detach().numpy()) for p in model.parameters()]
    depth = 2 * (len(s.hidden) + 1)
    n, r, m = s.n, s.r, s.m
    u, y = jnp.asarray(u, dtype), jnp.asarray(y, dtype)

    def encode(p: list, y0: object) -> object:
        for W, bias in zip(p[depth::2], p[depth + 1 :: 2], strict=True):
            y0 = y0 @ W.T + bias
        return y0

    def loss(p: list) -> object:
        def step(x: object, u_now: object) -> object:
            z = x
            for W, bias in zip(p[: depth - 2 : 2], p[1 : depth - 2 : 2], strict=True):
                z = jax.nn.sigmoid(z @ W.T + bias)
            theta = z @ p[depth - 2].T + p[depth - 1]
            W = theta[:, : 4 * n * n].reshape(-1, 2 * n, 2 * n)
            V = theta[:, 4 * n * n : 5 * n * n].reshape(-1, n, n)
            B = theta[:, 5 * n * n : 5 * n * n + n * r].reshape(-1, n, r)
            C = theta[:, 5 * n * n + n * r :].reshape(-1, m, n)
            S = jnp.swapaxes(W, 1, 2) @ W + np.exp(-10.0) * jnp.eye(2 * n, dtype=dtype)
            M = 0.5 * (S[:, :n, :n] + S[:, n:, n:]) + V - jnp.swapaxes(V, 1, 2)
            z = jnp.linalg.solve(M, x[..., None])
            x_next = (S[:, :n, n:] @ z + B @ u_now[..., None])[..., 0]
            return x_next, (x, (C @ x[..., None])[..., 0])

        _, (x, y_sim) = jax.lax.scan(step, encode(p, y[:, 0]), jnp.swapaxes(u, 0, 1))
        gap = x[1:] - encode(p, jnp.swapaxes(y, 0, 1)[1:])
        return jnp.mean((y_sim - jnp.swapaxes(y, 0, 1)) ** 2) + 0.01 * jnp.mean(gap**2)

    @jax.jit
    def update(p: list, a: list, b: list) -> tuple:
        gradient = jax.grad(loss)(p)
        a = [0.9 * x + 0.1 * g for x, g in zip(a, gradient, strict=True)]
        b = [0.999 * x + 0.001 * g * g for x, g in zip(b, gradient, strict=True)]
        p = [w - 1e-3 * x / (jnp.sqrt(v) + 1e-8) for w, x, v in zip(p, a, b, strict=True)]
        return p, a, b

    state = [parameters, [0 * p for p in parameters], [0 * p for p in parameters]]

    def step() -> None:
        state[:] = update(*state)
        jax.block_until_ready(state[0])

    return step


def compiled_torch_step(s: Setting, dtype: str, u: FloatArray, y: FloatArray) -> Callable[[], object]:
    """torch.compile of one sample's step inside the plain loop (the whole unrolled loop compiles for minutes)."""
    model = model_of(s, dtype)
    model.step = torch.compile(model.step, dynamic=False)  # type: ignore[method-assign]
    U, Y = torch.tensor(u, dtype=model.dtype), torch.tensor(y, dtype=model.dtype)
    optimiser = torch.optim.Adam(model.parameters(), lr=1e-3)

    def step() -> None:
        optimiser.zero_grad()
        training_loss(model, U, Y, 0.01).backward()
        optimiser.step()

    return step


def step_of(s: Setting, dtype: str, stability: str, L: int, batch: int) -> Callable[[], object]:
    """A step of Adam of the fast engine on windows of L samples."""
    random = np.random.default_rng(1)
    u, y = random.standard_normal((batch, L, s.r)), random.standard_normal((batch, L, s.m))
    engine = FastEngine(model_of(s, dtype, stability), u, y, Recipe(dtype=dtype))
    everything = np.arange(batch)
    return lambda: engine.train_batch(everything, 1)


def other_table() -> None:
    """What other promises cost, and whole records: each as a ratio to the Schur step on windows."""
    rows = []
    for dtype in ("float32", "float64"):
        for s in SETTINGS:
            schur, quadratic = side_by_side(step_of(s, dtype, kind, s.L, s.batch) for kind in ("schur", "quadratic"))
            window, record = (milliseconds(step_of(s, dtype, "schur", L, 1), 1.5) / L for L in (s.L, 2000))
            rows.append(
                {
                    "setting": s.name, "precision": dtype, "quadratic / schur": f"{quadratic / schur:.2f}",
                    "window, batch 1 [µs/sample]": f"{1e3 * window:.1f}",
                    "one record of 2000 [µs/sample]": f"{1e3 * record:.1f}",
                    "record / window": f"{record / window:.2f}",
                }
            )  # fmt: skip
    print("\nOther steps of the fast engine")
    print(tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True))


def incremental_table() -> None:
    """The incrementally stable layer, which is one, beside Schur's: of the released widths, one of these, 8 units."""
    rows = []
    for dtype in ("float32", "float64"):
        for s in SETTINGS:
            row = {"setting": s.name, "precision": dtype}
            for name, hidden in (("released widths", s.hidden), ("one layer", s.hidden[:1]), ("8 units", (8,))):
                sized = replace(s, hidden=hidden)
                schur, incremental = side_by_side(
                    step_of(sized, dtype, kind, s.L, s.batch) for kind in ("schur", "incremental")
                )
                row[f"{name} [ms]"] = f"{incremental:.2f} / {schur:.2f}"
                row[f"{name}: ratio"] = f"{incremental / schur:.2f}"
            rows.append(row)
    print("\nA step of the incrementally stable layer / a Schur step")
    print(tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True))


def train_table(with_jax: bool, with_compile: bool) -> None:
    rows = []
    for dtype in ("float32", "float64"):
        rate = gemm_rate(dtype)
        for s in SETTINGS:
            random = np.random.default_rng(1)
            u, y = random.standard_normal((s.batch, s.L, s.r)), random.standard_normal((s.batch, s.L, s.m))
            everything = np.arange(s.batch)
            plain = ReferenceEngine(model_of(s, dtype), u, y, Recipe(dtype=dtype))
            fast = FastEngine(model_of(s, dtype), u, y, Recipe(dtype=dtype))
            reference = milliseconds(lambda plain=plain, w=everything: plain.train_batch(w, 1))
            ours = milliseconds(lambda fast=fast, w=everything: fast.train_batch(w, 1))
            weights = sum(p.numel() for p in model_of(s, dtype).generator.parameters())
            long = np.random.default_rng(2).standard_normal((20_000, s.r))
            run = Weights(model_of(s, dtype))
            free_fast = milliseconds(lambda run=run, s=s, long=long: run.free_run(long, np.zeros(s.m)), 1.0) / len(long)
            model, some = model_of(s, dtype), long[:1000]
            free_plain = milliseconds(lambda model=model, s=s, some=some: model.simulate(some, np.zeros(s.m)), 1.0)
            row = {
                "setting": s.name, "precision": dtype, "reference [ms]": f"{reference:.1f}", "fast [ms]": f"{ours:.2f}",
                "ratio": f"{reference / ours:.1f}", "asked for": f"{s.target[dtype]:g}",
                "of GEMM limit": f"{6 * s.L * s.batch * weights / (ours * 1e-3) / rate:.0%}",
                "free run ratio": f"{free_plain / len(some) / free_fast:.0f}",
            }  # fmt: skip
            if with_jax:
                row["JAX ratio"] = f"{reference / milliseconds(jax_step(s, dtype, u, y)):.1f}"
            if with_compile:
                row["torch.compile ratio"] = f"{reference / milliseconds(compiled_torch_step(s, dtype, u, y)):.1f}"
            rows.append(row)
    print("NN-SS, one optimiser step, one core")
    print(tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True))


def simba_table() -> None:
    """SIMBa's step with written-out gradients against the plain torch loop."""
    rows = []
    for name, n, r, m, L, batch in (
        ("two-tank", 3, 1, 1, 80, 64),
        ("robot arm", 5, 1, 1, 100, 32),
        ("power plant", 4, 5, 3, 100, 1),
    ):
        random = np.random.default_rng(0)
        p = initial_parameters(None, n, r, m, 1.0, random)
        u, y = random.standard_normal((batch, L, r)), random.standard_normal((batch, L, m))
        tensors = {key: torch.tensor(value, requires_grad=True) for key, value in p.items()}
        U, Y = torch.tensor(u), torch.tensor(y)

        def plain(q: dict = tensors, U: torch.Tensor = U, Y: torch.Tensor = Y, L: int = L) -> None:
            A = schur_matrix(q["W"], q["V"])
            x = (Y[:, 0] - U[:, 0] @ q["D"].T) @ torch.linalg.pinv(q["C"]).T
            outputs = []
            for k in range(L):
                outputs.append(x @ q["C"].T + U[:, k] @ q["D"].T)
                x = x @ A.T + U[:, k] @ q["B"].T
            (torch.stack(outputs, 1) - Y).square().mean().backward()

        reference = milliseconds(plain, 1.0)
        u, y = u.transpose(1, 2, 0).copy(), y.transpose(1, 2, 0).copy()
        ours = milliseconds(lambda p=p, u=u, y=y: loss_and_gradient(p, u, y), 1.0)
        rows.append({"setting": name, "plain torch [ms]": reference, "ours [ms]": ours, "ratio": reference / ours})
    print("\nSIMBa, loss and gradient of a mini-batch, float64, one core")
    print(tabulate(rows, headers="keys", tablefmt="pipe", floatfmt=".2f"))


def compile_times() -> None:
    """First use in an empty cache, then in a new process."""
    import tempfile

    code = (
        "import time\nfrom nnss_cli.machine import prepare; prepare()\nfrom nnss_cli.training.fast import warm_up\n"
        "s = time.perf_counter(); warm_up('float32'); t = time.perf_counter(); warm_up('float64')\n"
        "print(f'float32 {t - s:.1f} s, float64 {time.perf_counter() - t:.1f} s')"
    )
    with tempfile.TemporaryDirectory() as folder:
        for when in ("first use", "a later process"):
            done = subprocess.run(
                [sys.executable, "-c", code], env=os.environ | {"NUMBA_CACHE_DIR": folder}, capture_output=True,
                text=True, check=True,
            )  # fmt: skip
            print(f"Compilation, {when}: {done.stdout.strip()}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jax", action="store_true", help="time JAX too (needs jax)")
    parser.add_argument("--torch-compile", action="store_true", help="time torch.compile too (needs a C++ compiler)")
    options = parser.parse_args()
    torch.set_num_threads(1)
    train_table(options.jax, options.torch_compile)
    other_table()
    incremental_table()
    simba_table()
    print()
    compile_times()


if __name__ == "__main__":
    main()
