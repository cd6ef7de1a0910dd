"""What mutation testing leaves out or counts apart: by rules, of which each is tried on a few lines."""

import textwrap

import pytest
from mutants import ROOT, Map, Mutant, _program, chosen_tests
from mutants_looks import places_of_looks, sets_looks


def looked_at(source: str) -> list[str]:
    """The pieces of a source that set looks alone."""
    lines = source.splitlines()
    return sorted(lines[first - 1][start:end] for (first, start), (_, end) in places_of_looks(source))


DRAWS = textwrap.dedent("""\
    import matplotlib.pyplot as plt
    heights = [1.9, 2]
    ticks = [1, 2]
    style = {"linewidth": 1.1, "color": "0.3", "label": 5, **more}
    panel.plot(x[0], y[1], linewidth=0.9, color="0.2", label="é", alpha=0.5)
    panel.set_xlim(-0.6, 3)
    panel.margins(x=0.01)
    panel.set_title(9, fontsize=7)
    plt.figure(figsize=(7, 3))
""")


def test_looks_are_sizes_thicknesses_and_dashes_and_never_data_limits_ticks_or_labels() -> None:
    assert looked_at(DRAWS) == sorted(["[1.9, 2]", "1.1", "0.9", "0.5", "0.01", "7", "(7, 3)"])
    places = places_of_looks(DRAWS)
    assert sets_looks(((4, 22), (4, 25)), places)  # the dictionary's thickness
    assert not sets_looks(((3, 9), (3, 10)), places)  # a tick
    assert not sets_looks(((6, 16), (6, 19)), places)  # a limit


def test_only_files_that_draw_or_say_how_have_looks() -> None:
    assert looked_at(DRAWS.partition("\n")[2]) == []
    styles = 'class MethodStyle:\n    pass\nMORE = (1, 2)\nWIDTHS = {1: 3.5}\nMEASURED = {"linewidth": 3.0}\n'
    assert looked_at(styles) == ["(1, 2)", "3.0"]
    assert looked_at(styles.replace("MethodStyle", "Other")) == []


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("def f(a: int | None) -> int | str: x: int | None = a", "def f(a: int) -> str: x: bool = a", True),
        ('a == "word"', 'a is "word"', True), ("a != 3", "a is not 3", True), ("a == b", "a is b", False),
        ("a == 3.0", "a is 3.0", False), ("a == None", "a is None", False), ("a == 3", "a != 3", False),
        ("a < b == 3", "a < b is 3", True), ("x = 1", "x = 2", False), ("f(1, *a)", "f(2, *a)", False),
    ],
)  # fmt: skip
def test_programs_are_the_same_where_only_annotations_or_identity_beside_a_literal_differ(
    one: str, other: str, same: bool
) -> None:
    assert (_program(one) == _program(other)) is same


def test_a_mutant_is_judged_by_what_ran_its_statement_and_by_who_may_look_at_what_that_made() -> None:
    file = "nnss_cli/report/cells.py"  # `whole` is one statement, `plain` is others
    source = (ROOT / file).read_text(encoding="utf-8").splitlines()
    whole = 1 + next(i for i, line in enumerate(source) if line.startswith("    return Cell(str(value)"))
    plain = 1 + next(i for i, line in enumerate(source) if line.startswith("    return found"))
    seconds = {f"tests/report/test_{name}": 1.0 for name in ("a.py::ran", "a.py::looks", "a.py::other", "b.py::none")}
    lines = {file: {whole: {"tests/report/test_a.py::ran"}, plain: {"tests/report/test_a.py::other"}}}
    mutant = Mutant("x", file, "", whole, ("tests/report",))
    assert chosen_tests(mutant, Map(seconds, lines)) == ["tests/report/test_a.py::ran", "tests/report/test_a.py::looks"]
    fixture = {file: {whole: {"tests/report/test_b.py"}, plain: {"tests/report/test_a.py::other"}}}
    assert chosen_tests(mutant, Map(seconds, fixture)) == ["tests/report/test_b.py::none"]
