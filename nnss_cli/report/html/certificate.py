"""What is known of the stability of a folder's models: what their option promises, and what was seen of them.

Nothing is simulated or searched here, and no model is built: the promise stands in model.json, the matrices of a linear
model beside it, the states along the records in the run's signals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from nnss_cli.baselines.statespace import spectral_radius
from nnss_cli.errors import InputError
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.modelfile import Tensors, read_model
from nnss_cli.report.aggregate import groups
from nnss_cli.report.tables import number, promise_of


def certificate_table(store: Store, results: Sequence[RunResult]) -> list[dict[str, str]]:
    """A row for each method and order: the promise, and the largest that was seen over all of its runs."""
    rows = []
    for method, order, own in groups(results):
        sound = [result for result in own if result.status == "ok"]
        if not sound:
            continue
        promises: dict[str, int] = {}
        radius, state = -math.inf, -math.inf
        for result in sound:
            promise, own_radius = _of_model(*_model(store, result))
            promises[promise] = promises.get(promise, 0) + 1
            radius = max(radius, own_radius)
            state = max(state, _largest_state(store.signals(result.spec)))
        rows.append(
            {
                "order": str(order), "method": method, "runs": str(len(sound)),
                "promised": "; ".join(
                    name if len(promises) == 1 else f"{name} ({count} runs)" for name, count in promises.items()
                ),
                "ρ(A) of a linear model, largest": number(radius) if radius > -math.inf else "–",
                "‖x‖ on the records, largest": number(state),
            }
        )  # fmt: skip
    return rows


def _model(store: Store, result: RunResult) -> tuple[dict[str, Any], Tensors]:
    try:
        return read_model(store.run_folder(result.spec))
    except InputError:
        return {}, {}


def _of_model(description: dict[str, Any], tensors: Tensors) -> tuple[str, float]:
    """Its promise, and its spectral radius where it has one A."""
    members = description.get("members")
    if isinstance(members, list) and members:
        found = {_of_model(member, {})[0] for member in members if isinstance(member, dict)}
        return "each member: " + " or ".join(sorted(found)), -math.inf
    architecture = description.get("architecture")
    if isinstance(architecture, dict):
        stability, gamma = str(architecture.get("stability", "")), architecture.get("gamma", math.inf)
        promise = promise_of(stability, float(gamma) if isinstance(gamma, int | float) else math.inf)
        if architecture.get("integrator") is True:
            promise += "; an integrator follows, which is bounded for no constant input"
        return promise, -math.inf
    A = tensors.get("A")
    if description.get("kind") == "linear" and A is not None and A.ndim == 2 and A.shape[0] == A.shape[1]:
        return "nothing; its A is fixed, so ρ(A) decides", spectral_radius(A)
    return "not known: no model is kept" if not description else "not known of this kind of model", -math.inf


def _largest_state(signals: Tensors) -> float:
    norms = [float(np.linalg.norm(x, axis=1).max()) for name, x in signals.items() if name.endswith("/x") and x.size]
    return max(norms, default=math.nan)
