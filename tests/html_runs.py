"""Runs on disk for the tests of the page: made up, but with signals that give their scores, as `Store` asks."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from nnss_cli.datasets.record import Scaling

from nnss_cli.experiment.run import RunResult, RunSpec, score_outputs
from nnss_cli.experiment.store import Store

HOSTILE = '"><script>window.boom=1</script><img src=x onerror="window.boom=1">'
"""What a name in a file may be, where it names no folder."""
HOSTILE_FOLDER = "<img src=x onerror=window.boom=1>"
"""Likewise, where it does."""


def make_runs(
    out: Path,
    dataset: str = "plant",
    methods: tuple[str, ...] = ("nnss", "nnss-ensemble", "simba", "n4sid"),
    orders: tuple[int, ...] = (2, 3),
    seeds: int = 7,
    text: str = "",
    K: int = 150,
    protocol: str = "strict",
    outputs: int = 1,
) -> Store:
    """Write runs: those of seeded methods for every seed; the last seed of simba has no result.

    Args:
        out: the results folder.
        dataset: its name.
        methods: their names; one that is not known is seeded.
        orders: of the models.
        seeds: number of them.
        text: what stands in every field that is the user's or the machine's, in front of what belongs there.
        K: samples of a split.
        protocol: its name.
        outputs: number of outputs.
    """
    store = Store(out, dataset, protocol)
    for number, method in enumerate(methods):
        for order in orders:
            for seed in range(seeds if method not in ("n4sid", "ssest", "nnss-ensemble") else 1):
                lost = method == "simba" and seed == seeds - 1
                _write(store, method, order, seed, text, K, outputs, number, lost)
    return store


def _write(
    store: Store, method: str, order: int, seed: int, text: str, K: int, outputs: int, number: int, lost: bool
) -> None:
    random = np.random.default_rng([number, order, seed])
    time = np.arange(K) * 0.2
    signals: dict[str, Any] = {"Ts": np.array([0.2])}
    scores = []
    scaling = Scaling(*(np.full(size, value) for size, value in ((1, 0.0), (1, 1.0), (outputs, 0.0), (outputs, 0.7))))
    for index, split in enumerate(("train", "val", "test")):
        y = np.stack([np.sin(0.3 * time + index + i) * (i + 1) for i in range(outputs)], axis=1)
        y_sim = y + (0.02 + 0.03 * number + 0.01 * order) * random.normal(size=y.shape)
        signals |= {
            f"{split}/0/u": np.sign(np.sin(0.1 * time))[:, None], f"{split}/0/y": y, f"{split}/0/y_sim": y_sim,
            f"{split}/0/x": random.normal(size=(K, order)),
        }  # fmt: skip
        scores += score_outputs(split, [y], [y_sim], scaling)
    iterative = method not in ("n4sid", "ssest", "nnss-ensemble")
    epochs = 40 + seed if iterative else 0
    history = {}
    if iterative:
        fall = np.exp(-np.arange(epochs) / 20)
        history = {"train_loss": (0.1 * fall + 0.01).tolist(), "val_rmse": (0.5 * fall + 0.05 + 0.01 * seed).tolist()}
    if method == "nnss":
        history |= {"val_rmse, as it is": [0.4], f"val_rmse, cold start{text}": [0.2 + 0.001 * seed]}
    provenance = {
        "nnss": "0.1.0", "commit": "0123456789ab-dirty", "python": "3.11.7", "numpy": "2.4.6", "cpu": f"{text}CPU",
        "machine": "Linux x86_64", "threads": "OMP_NUM_THREADS=1", "command": f"nnss compare {store.dataset} {text}",
        "started": "2026-01-02T03:04:05.678+00:00", "finished": f"2026-01-02T03:05:{seed:02d}.678+00:00",
        "seconds": f"{1.5 + seed}", "peak memory [MB]": f"{400 + seed}",
    }  # fmt: skip
    result = RunResult(
        RunSpec(
            store.dataset, store.protocol, method, order, seed, {"epochs": 60, "stability": f"schur{text}"}, "abc", "1"
        ),
        "diverged" if lost else "ok", f"loss is not finite {text}" if lost else "", () if lost else tuple(scores),
        epochs, round(1.25 + seed + order, 3), provenance, history,
        {
            "inputs": [f"u{text}"], "outputs": [f"level{i + 1}{text}" for i in range(outputs)],
            "input_units": ["V"], "output_units": [f"m{text}"] * outputs,
        },
        (f"A note {text}",), (f"cold start{text} taken: it lowers the validation error",) if method == "nnss" else (),
    )  # fmt: skip
    folder = store.run_folder(result.spec)
    folder.mkdir(parents=True)
    description: dict[str, Any] = {"kind": "nnss", "architecture": {"stability": "schur", "gamma": 0.98}}
    (folder / "model.json").write_text(json.dumps(description), encoding="utf-8")
    store.write(result, {} if lost else signals)
