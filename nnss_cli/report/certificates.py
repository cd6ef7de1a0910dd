"""Certificates as text: one in full, or many side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from nnss_cli.report.cells import Cell
from nnss_cli.report.tables import number, promise_of

if TYPE_CHECKING:  # it imports torch, which a report does without
    from nnss_cli.experiment.certificate import Certificate
    from nnss_cli.experiment.certificate.result import Gain

SHORT = {"proved": "P", "sampled": "S", "refuted": "R", "unknown": "?"}


def statement_rows(found: Certificate) -> list[dict[str, str]]:
    """What is said, each with how far it is known, for what it holds and how it is known."""
    rows = [
        {"": each.name, "status": each.status, "claim": each.claim, "for": each.holds_for or "–", "how": each.how}
        for each in found.statements
    ]
    to = "y" if found.covers == "the model" else "what is integrated"
    gains = ((f"ℓ2 gain u → {to}", found.gain), ("gain of differences", found.incremental_gain))
    return rows + [
        {"": name, "status": gain.status, "claim": _claim(gain), "for": gain.holds_for or "–", "how": gain.how}
        for name, gain in gains
    ]


def examined(found: Certificate) -> str:
    """What the statements are of, for their head; "" for all of the model."""
    return "" if found.covers == "the model" else f" of {found.covers}; the sum's eigenvalues are exactly 1, by choice"


def _claim(gain: Gain) -> str:
    bound = "no bound" if gain.bound is None else f"≤ {number(gain.bound)}"
    if gain.bound_physical is not None:
        bound += f" ({number(gain.bound_physical)} physical)"
    if gain.attack is not None:
        bound += f"; reached {number(gain.attack)}"
        bound += f" ({number(gain.attack_physical)} physical)" * (gain.attack_physical is not None)
    if gain.tightness is not None:
        bound += f"; tightness {number(gain.tightness, 2)}"
    return bound + ", by stronger inputs than the bound is of" * _by_stronger_inputs(gain)


def _by_stronger_inputs(gain: Gain) -> bool:
    """Whether the attack is no measure of the bound, and may exceed it: its inputs are not among the bound's."""
    return bool(gain.bound) and gain.attack is not None and gain.tightness is None


def summary_rows(found: Sequence[tuple[str, Certificate]]) -> list[dict[str, str]]:
    """Many models, one a row; * after what was reached by stronger inputs than the bound is of."""
    rows = []
    for name, each in found:
        known = {s.name: SHORT[s.status] for s in each.statements}
        rows.append(
            {
                "model": name, "stability": each.stability + " (LPV part)" * bool(examined(each)),
                "ρ(A)<1": known["frozen"], "quadr.": known["quadratic"],
                "state": known["state"], "increm.": known["incremental"], "gain ≤": number(each.gain.bound),
                "reached": Cell(number(each.gain.attack) + "*" * _by_stronger_inputs(each.gain), each.gain.attack),
                "tight": number(each.gain.tightness, 2),
                "incr. gain ≤": number(each.incremental_gain.bound), "broken": str(len(each.broken)),
            }
        )  # fmt: skip
    return rows


def certificate_rows(found: Certificate) -> list[dict[str, str]]:
    """A certificate as text."""

    def known(value: float | None) -> str:
        return "–" if value is None else number(value, 6)

    promise = promise_of(found.stability, found.gamma)
    linear = found.kind == "linear"
    where = "the only A" if linear else "box, sampled"
    rows = {
        **({"examined": found.covers} if found.covers != "the model" else {}),
        "promised": promise,
        **{f"largest ρ(A), {split}": known(radius) for split, radius in found.radius.items()},
        **{f"largest ‖x‖, {split}": known(state) for split, state in found.state.items()},
        f"largest ρ(A), {where}": known(found.box_radius),
        f"largest ‖A‖, {where}": known(found.box_norm),
        "certified rate": known(found.gamma) if found.stability in ("quadratic", "incremental") else "–",
        "certified sup‖x‖": f"{known(found.state_bound)}{', for ' * bool(found.holds_for)}{found.holds_for}",
        "invariant ball ‖x‖ ≤": known(found.invariant_radius),
        "largest ‖x(0)‖ of the records": known(found.initial_state),
        "sup‖B‖, sup‖C‖, sup‖D‖": ", ".join(map(known, (found.B_bound, found.C_bound, found.D_bound))),
        "sup‖u‖": known(found.input_bound),
        "common Lyapunov matrix": found.lyapunov,
        "its rate" if linear else "its rate, sampled set": known(found.lyapunov_rate),
    }
    return [{"": name, "found": value} for name, value in rows.items()]


def stress_rows(found: Certificate) -> list[dict[str, str]]:
    """Stress runs as text."""
    return [
        {"input": run.input, "steps": str(run.steps), "max ‖x‖": number(run.state), "max |y|": number(run.output)}
        for run in found.stress
    ]
