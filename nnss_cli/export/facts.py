"""What travels with every export, as data and as a comment: signals, coordinates, origin, the certificate."""

from __future__ import annotations

import textwrap
from dataclasses import asdict
from typing import Any

from nnss_cli.datasets.units import titled
from nnss_cli.errors import InputError
from nnss_cli.experiment.certificate import Certificate, certify
from nnss_cli.trained import TrainedModel
from nnss_cli.version import __version__

CERTIFIED = (
    "kind", "stability", "gamma", "radius", "box_radius", "box_norm", "state_bound", "invariant_radius", "holds_for",
    "B_bound", "C_bound", "D_bound", "input_bound", "broken",
)  # fmt: skip


def facts_of(model: TrainedModel) -> dict[str, Any]:
    """Plain data about a model: names, units, scaling, coordinates, origin, certificates."""
    system, origin, scaling = model.system, model.origin, model.scaling
    certificates, missing = _certificates(model)
    return {
        "made_by": f"nnss {__version__}",
        "model": model.label,
        "Ts": model.Ts,
        **asdict(model.channels),
        "states": list(system.state_names),
        "coordinates": (
            "u and y in physical units; x are the model's own states, which belong to signals scaled by their mean and "
            "deviation" + ("; y_previous is the output before, in physical units" if system.outputs_kept else "")
        ),
        "scaling": {name: values.tolist() for name, values in asdict(scaling).items()} if scaling else None,
        "init_window": model.init_window,
        "start": start_of(model),
        "fingerprint": model.fingerprint,
        "training": asdict(origin) if origin else None,
        "certificate": certificates,
        "certificate_missing": missing,
    }


def start_of(model: TrainedModel) -> str:
    """What an export does not say of z(0) by itself: that the model finds it otherwise; "" where it does not."""
    if model.init_window == 1:
        return ""
    return (
        f"Start: the model finds z(0) from the first {model.init_window} output samples. That search is not exported: "
        f"initial gives a first guess, from {model.system.starts_from}, and simulations from there may err more than "
        "nnss says. Find z(0) in Python by model.initial_state(u, y_init), and start from it."
    )


def _certificates(model: TrainedModel) -> tuple[list[dict[str, Any]], str]:
    """Of the model, or of each member of an ensemble; none and why where they cannot be computed."""
    records = model.records()
    if not records:
        return [], "the records that it speaks of are not kept with the model"
    try:
        found = [
            certify(member, records, steps=0, search_lyapunov=False)
            for member in getattr(model.model, "members", (model.model,))
        ]
    except InputError as error:
        return [], str(error)
    return [_kept(certificate) for certificate in found], ""


def _kept(certificate: Certificate) -> dict[str, Any]:
    content = certificate.to_json()
    return {name: content[name] for name in CERTIFIED}


def certificate_lines(facts: dict[str, Any]) -> list[str]:
    """The certificates in words."""
    lines = []
    for number, c in enumerate(facts["certificate"]):
        of = f" of member {number + 1}" if len(facts["certificate"]) > 1 else ""
        largest = max(c["radius"].values())
        text = (
            f"Certificate{of} (normalised units): stability {c['stability']}, spectral radius of A at most "
            f"{largest:.6g} along the records, {c['box_radius']:.6g} found in their box"
        )
        if c["gamma"] is not None:
            text += f", promised below {c['gamma']:g}"
        if c["state_bound"] is not None:
            text += (
                f"; ||x(k)|| <= {c['state_bound']:.6g} for {c['holds_for']}, in exact arithmetic; the ball of radius "
                f"{c['invariant_radius']:.6g} is never left under ||u|| <= {c['input_bound']:.6g}"
            )
        elif c["stability"] == "schur":
            text += "; a Schur A(x) at every x does not bound a trajectory"
        lines.append(text + ("; BROKEN: " + "; ".join(c["broken"]) if c["broken"] else "") + ".")
    if not lines:
        lines.append(f"Certificate: none, since {facts['certificate_missing']}.")
    return lines


def header(facts: dict[str, Any], width: int = 110) -> list[str]:
    """The head of a source file, line by line, without comment signs."""

    def signals(kind: str) -> str:
        return ", ".join(map(titled, facts[f"{kind}s"], facts[f"{kind}_units"]))

    text = [
        f"{facts['model']}. Made by {facts['made_by']}; do not edit.",
        f"Inputs u: {signals('input')}. Outputs y: {signals('output')}. Sampling time {facts['Ts']:.9g} s.",
        f"States z: {', '.join(facts['states'])}. {facts['coordinates'][0].upper()}{facts['coordinates'][1:]}.",
        facts["start"],
        f"Training data: fingerprint {facts['fingerprint'] or 'unknown'}.",
        *certificate_lines(facts),
    ]
    return [line for paragraph in text for line in textwrap.wrap(" ".join(paragraph.split()), width)]
