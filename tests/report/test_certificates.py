"""A certificate as text, cell by cell: no bound is told that was not proved, and nothing that was is left out."""

from types import SimpleNamespace
from typing import Any

import pytest

from nnss_cli.report.cells import plain
from nnss_cli.report.certificates import certificate_rows, examined, statement_rows, stress_rows, summary_rows
from nnss_cli.report.tables import promise_of

GAIN = {"status": "proved", "bound": 2.0, "bound_physical": 40.0, "attack": 1.5, "attack_physical": 30.0,
        "tightness": 0.75, "holds_for": "x(0) = 0", "how": "an LMI"}  # fmt: skip
NO_GAIN = dict.fromkeys(GAIN) | {"status": "unknown", "holds_for": "", "how": "none found"}


def statement(name: str, status: str, **more: Any) -> SimpleNamespace:
    return SimpleNamespace(name=name, status=status, **{"claim": f"{name}!", "holds_for": "all", "how": "so"} | more)


def certificate(**changed: Any) -> Any:
    known = {
        "kind": "nnss", "stability": "schur", "covers": "the model", "gamma": 0.999, "holds_for": "every x(0)",
        "radius": {"train": 0.91, "test": 0.92}, "state": {"train": 1.25, "test": 1.5}, "initial_state": 0.5,
        "box_radius": 0.95, "box_norm": 1.75, "state_bound": 8.0, "invariant_radius": 7.0,
        "B_bound": 1.0, "C_bound": 2.0, "D_bound": 3.0, "input_bound": 4.0,
        "lyapunov": "found", "lyapunov_rate": 0.98, "gain": SimpleNamespace(**GAIN),
        "incremental_gain": SimpleNamespace(**NO_GAIN), "broken": (), "stress": (),
        "statements": (statement("frozen", "proved"), statement("quadratic", "sampled"),
                       statement("state", "refuted"), statement("incremental", "unknown", holds_for="")),
    }  # fmt: skip
    return SimpleNamespace(**known | changed)


def found(certificate: Any) -> dict[str, str]:
    return {row[""]: row["found"] for row in certificate_rows(certificate)}


def test_every_statement_stands_with_its_status_and_the_gains_after_it() -> None:
    rows = statement_rows(certificate())
    assert [(row[""], row["status"], row["claim"], row["for"], row["how"]) for row in rows] == [
        ("frozen", "proved", "frozen!", "all", "so"), ("quadratic", "sampled", "quadratic!", "all", "so"),
        ("state", "refuted", "state!", "all", "so"), ("incremental", "unknown", "incremental!", "–", "so"),
        ("ℓ2 gain u → y", "proved", "≤ 2 (40 physical); reached 1.5 (30 physical); tightness 0.75", "x(0) = 0",
         "an LMI"),
        ("gain of differences", "unknown", "no bound", "–", "none found"),
    ]  # fmt: skip
    rows = statement_rows(certificate(covers="its LPV part"))
    assert rows[-2][""] == "ℓ2 gain u → what is integrated"


@pytest.mark.parametrize(
    ("gain", "claim"),
    [
        ({"bound_physical": None}, "≤ 2; reached 1.5 (30 physical); tightness 0.75"),
        ({"attack_physical": None}, "≤ 2 (40 physical); reached 1.5; tightness 0.75"),
        ({"attack": None, "tightness": None}, "≤ 2 (40 physical)"),
        ({"bound": None, "bound_physical": None, "tightness": None}, "no bound; reached 1.5 (30 physical)"),
        ({"bound": 0.0, "bound_physical": 0.0, "attack": 0.0, "attack_physical": 0.0, "tightness": 0.123},
         "≤ 0 (0 physical); reached 0 (0 physical); tightness 0.12"),
        ({"bound": 0.0, "bound_physical": 0.0, "attack": 0.0, "attack_physical": 0.0, "tightness": None},
         "≤ 0 (0 physical); reached 0 (0 physical)"),
        ({"attack": 2.5, "attack_physical": 50.0, "tightness": None},  # may exceed the bound, and says why
         "≤ 2 (40 physical); reached 2.5 (50 physical), by stronger inputs than the bound is of"),
    ],
)  # fmt: skip
def test_a_gain_tells_what_is_known_of_it_alone(gain: dict[str, Any], claim: str) -> None:
    assert statement_rows(certificate(gain=SimpleNamespace(**GAIN | gain)))[-2]["claim"] == claim


def test_many_models_stand_one_a_row() -> None:
    rows = summary_rows([("a", certificate(broken=("x", "y"))), ("b", certificate(incremental_gain=SimpleNamespace(
        **GAIN | {"bound": 3.0})))])  # fmt: skip
    first = {"model": "a", "stability": "schur", "ρ(A)<1": "P", "quadr.": "S", "state": "R", "increm.": "?",
             "gain ≤": "2", "reached": "1.5", "tight": "0.75", "incr. gain ≤": "–", "broken": "2"}  # fmt: skip
    assert rows == [first, first | {"model": "b", "incr. gain ≤": "3", "broken": "0"}]
    stronger = SimpleNamespace(**GAIN | {"attack": 2.5, "tightness": None})
    (marked,) = summary_rows([("a", certificate(gain=stronger))])
    assert marked == first | {"reached": "2.5*", "tight": "–", "broken": "0"}
    assert plain([marked])[0]["reached"] == 2.5  # for machines


def test_of_an_integrator_it_is_said_at_once_that_the_lpv_part_is_meant() -> None:
    assert examined(certificate()) == ""
    part = certificate(covers="the LPV part: so")
    assert examined(part) == " of the LPV part: so; the sum's eigenvalues are exactly 1, by choice"
    assert [row["stability"] for row in summary_rows([("a", part), ("b", certificate())])] == [
        "schur (LPV part)", "schur",
    ]  # fmt: skip


def test_a_certificate_cell_by_cell() -> None:
    assert found(certificate()) == {
        "promised": "ρ(A(ρ)) < 0.999 at every ρ", "largest ρ(A), train": "0.91", "largest ρ(A), test": "0.92",
        "largest ‖x‖, train": "1.25", "largest ‖x‖, test": "1.5", "largest ρ(A), box, sampled": "0.95",
        "largest ‖A‖, box, sampled": "1.75", "certified rate": "–", "certified sup‖x‖": "8, for every x(0)",
        "invariant ball ‖x‖ ≤": "7", "largest ‖x(0)‖ of the records": "0.5", "sup‖B‖, sup‖C‖, sup‖D‖": "1, 2, 3",
        "sup‖u‖": "4", "common Lyapunov matrix": "found", "its rate, sampled set": "0.98",
    }  # fmt: skip
    assert found(certificate(box_radius=0.99999949))["largest ρ(A), box, sampled"] == "0.999999"


def test_a_certificate_without_bounds_says_so() -> None:
    nothing = found(certificate(state_bound=None, holds_for="", invariant_radius=None, lyapunov_rate=None, gamma=None))
    assert nothing["certified sup‖x‖"] == nothing["invariant ball ‖x‖ ≤"] == nothing["its rate, sampled set"] == "–"
    assert nothing["promised"] == "nothing"
    assert "examined" not in nothing


@pytest.mark.parametrize(("stability", "rate"), [("quadratic", "0.9"), ("incremental", "0.9"), ("schur", "–")])
def test_only_a_rate_that_bounds_trajectories_is_certified(stability: str, rate: str) -> None:
    assert found(certificate(stability=stability, gamma=0.9))["certified rate"] == rate


def test_a_linear_models_figures_are_not_said_to_be_sampled() -> None:
    told = found(certificate(kind="linear", covers="its LPV part"))
    assert (told["largest ρ(A), the only A"], told["largest ‖A‖, the only A"]) == ("0.95", "1.75")
    assert told["its rate"] == "0.98"
    assert told["examined"] == "its LPV part"
    assert not [name for name in told if "sampled" in name]


def test_stress_runs_are_tabled() -> None:
    runs = (SimpleNamespace(input="noise", steps=100, state=1.5, output=2.5),)
    assert stress_rows(certificate(stress=runs)) == [
        {"input": "noise", "steps": "100", "max ‖x‖": "1.5", "max |y|": "2.5"}
    ]


@pytest.mark.parametrize(
    ("stability", "gamma", "promise"),
    [
        ("incremental", 0.5, "‖x1(k) − x2(k)‖ ≤ 0.5ᵏ ‖x1(0) − x2(0)‖ under any one input"),
        ("schur", 1.0, "ρ(A(ρ)) < 1 at every ρ"), ("quadratic", 0.25, "‖A(ρ)‖ < 0.25 at every ρ"),
        ("none", 1.0, "nothing"), ("schur", None, "nothing"),
    ],
)  # fmt: skip
def test_a_promise_is_the_options_own(stability: str, gamma: float | None, promise: str) -> None:
    assert promise_of(stability, gamma) == promise
