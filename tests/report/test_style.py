"""Ticks, legends and looks by their rules, without a figure."""

import pytest

from nnss_cli.errors import InputError
from nnss_cli.report.style import (
    FORMATS,
    MORE,
    STYLE,
    STYLES,
    Look,
    _linear_ticks,
    legend_columns,
    log_ticks,
    styles_of,
)


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (1, 10, [1, 2, 5, 10]), (1, 1000, [1, 10, 100, 1000]), (1, 5, [1, 1.5, 2, 3, 5]), (7, 70, [10, 20, 50]),
        (1, 3, [1, 1.5, 2, 2.5, 3]), (2e-5, 7e-3, [3e-5, 1e-4, 3e-4, 1e-3, 3e-3]), (1e-4, 9e-4, [1e-4, 1.5e-4, 2e-4,
         3e-4, 5e-4, 7e-4]),
        # more decades than ticks: every second one, or third, counted from one
        (1, 1e6, [1, 100, 1e4, 1e6]), (0.3, 1.1e6, [1, 100, 1e4, 1e6]), (1e-3, 1e3, [0.01, 1, 100]),
        (1, 1e12, [1, 1e3, 1e6, 1e9, 1e12]),
        # hardly a part of one: round numbers at equal distances
        (100, 101, [100, 100.2, 100.4, 100.6, 100.8, 101]), (1.01, 1.09, [1.02, 1.04, 1.06, 1.08]),
        (9.99, 10.01, [9.99, 9.995, 10, 10.005, 10.01]),
    ],
)  # fmt: skip
def test_ticks_of_a_logarithmic_axis(low: float, high: float, ticks: list[float]) -> None:
    assert log_ticks(low, high) == pytest.approx(ticks, rel=1e-12)


def test_no_more_ticks_than_asked_for() -> None:
    assert log_ticks(1, 100, most=5) == [1, 3, 10, 30, 100]
    assert log_ticks(1, 100, most=4) == [1, 10, 100]
    assert log_ticks(1, 1e5, most=2) == pytest.approx([1, 1e3])
    assert log_ticks(9, 101, most=2) == [10, 100]  # two will do where they are decades


@pytest.mark.parametrize(
    ("low", "high", "most", "ticks"),
    [
        (1, 2, 6, [1, 1.2, 1.4, 1.6, 1.8, 2]), (1, 2, 5, [1, 1.5, 2]), (1, 2, 2, [1, 2]),
        (0.5, 5.5, 5, [1, 2, 3, 4, 5]),
        (0.5, 5.5, 4, [2, 4]), (99.5, 102.3, 3, [100, 101, 102]), (0, 10, 6, [2, 4, 6, 8, 10]),
    ],
)  # fmt: skip
def test_round_numbers_as_many_as_fit(low: float, high: float, most: int, ticks: list[float]) -> None:
    assert _linear_ticks(low, high, most) == ticks


def test_columns_of_a_legend() -> None:
    found = {most: [legend_columns(entries, most) for entries in range(1, 10)] for most in (1, 2, 3, 4, 6)}
    assert found == {
        1: [1] * 9, 2: [1, 2, 2, 2, 2, 2, 2, 2, 2], 3: [1, 2, 3, 2, 3, 3, 3, 3, 3], 4: [1, 2, 3, 4, 3, 3, 4, 4, 3],
        6: [1, 2, 3, 4, 5, 6, 4, 4, 5],
    }  # fmt: skip


def test_plug_ins_that_would_look_alike_take_the_next_look_while_there_is_one() -> None:
    # by their names alone theirs, third, fourth and d would all look the same
    names = ["theirs", "nnss", "third", "fourth", "d"]
    looks = styles_of([*names, "nnss"])
    assert list(looks) == names
    assert looks["nnss"] is STYLES["nnss"]
    order = [
        MORE.index(next(m for m in MORE if m.colour == looks[n].colour)) for n in ("d", "fourth", "theirs", "third")
    ]
    assert order == [0, 1, 2, 3]
    fifth = styles_of(["theirs", "third", "fourth", "d", "e"])
    assert len({look.colour for look in fifth.values()}) == 4  # all are taken
    own = fifth["e"]
    assert own.label == "e"
    alike = next(m for m in MORE if m.colour == own.colour)
    assert (own.line, own.hatch, own.marker) == (alike.line, alike.hatch, alike.marker)


def test_a_look_is_as_wide_as_its_columns_with_letters_to_match() -> None:
    assert [Look(columns=columns).width for columns in (None, 1, 2)] == [None, 3.5, 7.16]
    assert [Look(columns=columns).style["font.size"] for columns in (None, 1, 2)] == [STYLE["font.size"], 7, 8]
    assert Look(("png", "pdf")).formats == ("png", "pdf")
    assert FORMATS == ("png", "svg", "pdf")
    for wrong in (0, 3):
        with pytest.raises(InputError, match=f"--columns: expected 1 or 2, found {wrong}"):
            Look(columns=wrong)
    with pytest.raises(InputError, match="gif"):
        Look(("png", "gif"))
