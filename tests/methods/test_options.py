"""Options of methods: what a dataclass declares, what the command line and Python may say."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS
from nnss_cli.methods.options import for_method, options_of


@dataclass(frozen=True)
class Base:
    """What a base class declares is an option too."""

    count: int = 3
    """How many."""


@dataclass(frozen=True)
class Declared(Base):
    """One of each type."""

    rate: float = 0.5
    """Step size,
    over two lines."""
    fast: bool = False
    word: str = "a"
    kind: Literal["x", "y"] = "x"
    grade: int = field(default=1, metadata={"choices": (1, 2, 4)})
    widths: tuple[int, ...] = (5,)
    maybe: Literal["p", "q"] | None = None


def test_types_choices_and_docstrings_are_read_from_the_dataclass() -> None:
    options = options_of(Declared)
    assert list(options) == [each.name for each in dataclasses.fields(Declared)]
    assert (options["count"].doc, options["rate"].doc, options["fast"].doc) == (
        "How many.", "Step size, over two lines.", "",
    )  # fmt: skip
    assert {name: option.choices for name, option in options.items() if option.choices} == {
        "kind": ("x", "y"), "grade": (1, 2, 4), "maybe": ("p", "q"),
    }  # fmt: skip
    assert [option.name for option in options.values() if option.several] == ["widths"]


@pytest.mark.parametrize("name", METHODS.built_in)
def test_every_option_of_a_built_in_method_says_what_it_is(name: str) -> None:
    options = options_of(METHODS[name].options)
    assert all(option.doc for option in options.values())
    assert bool(options) != bool(METHODS[name].members)


VALUES = st.fixed_dictionaries(
    {
        "count": st.integers(), "rate": st.floats(allow_nan=False, allow_infinity=False), "fast": st.booleans(),
        "word": st.text(), "kind": st.sampled_from(["x", "y"]), "grade": st.sampled_from([1, 2, 4]),
        "widths": st.lists(st.integers(), min_size=1).map(tuple), "maybe": st.sampled_from(["p", "q"]),
    }
)  # fmt: skip


@given(VALUES)
def test_what_is_written_on_the_command_line_is_what_python_says(values: dict[str, Any]) -> None:
    options = options_of(Declared)
    for name, value in values.items():
        written = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
        for found in (options[name].parse(written), options[name].value(value)):
            assert found == value
            assert type(found) is type(value)


@pytest.mark.parametrize(
    ("name", "bad", "words"),
    [
        ("count", "3.5", "a whole number, found '3.5'"), ("count", "", "a whole number, found ''"),
        ("rate", "fast", "a number, found 'fast'"), ("rate", "nan", "a number, found 'nan'"),
        ("rate", "inf", "found 'inf'"), ("fast", "maybe", "true or false, found 'maybe'"),
        ("kind", "z", "unknown kind 'z': choose from x, y"), ("grade", "3", "unknown grade '3': choose from 1, 2, 4"),
        ("widths", "5,x", "found 'x'"), ("maybe", "z", "choose from p, q"),
    ],
)  # fmt: skip
def test_bad_words_name_the_option_and_what_was_expected(name: str, bad: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as error:
        options_of(Declared)[name].parse(bad)
    assert name in str(error.value)


@pytest.mark.parametrize(("name", "bad"), [
    ("count", 3.5), ("count", True), ("count", "3"), ("rate", "0.5"), ("rate", float("nan")), ("fast", 1),
    ("word", 3), ("widths", 5), ("widths", (5, "x")), ("kind", None),
])  # fmt: skip
def test_bad_values_from_python(name: str, bad: object) -> None:
    with pytest.raises(InputError, match=name):
        options_of(Declared)[name].value(bad)


def test_python_may_say_it_in_numpy_and_lists() -> None:
    import numpy as np

    options = options_of(Declared)
    assert options["widths"].value([np.int64(5), 6]) == (5, 6)
    assert type(options["rate"].value(np.float32(0.5))) is float
    assert type(options["rate"].value(1)) is float


@dataclass(frozen=True)
class NoDefault:
    """Lacks a default."""

    count: int


@dataclass(frozen=True)
class OddType:
    """Has a type that no word can stand for."""

    table: dict[str, int] = field(default_factory=dict)


@dataclass
class NotFrozen:
    """Can be changed."""

    count: int = 1


@pytest.mark.parametrize(
    ("declared", "words"),
    [(NoDefault, "NoDefault.count has no default"), (OddType, "OddType.table: expected bool"),
     (NotFrozen, "not frozen"), (dict, "expected a frozen dataclass")],
)  # fmt: skip
def test_options_that_are_no_options(declared: type, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        options_of(declared)


def test_settings_for_one_method_go_before_those_for_all() -> None:
    overrides = {"epochs": 5, "simba.epochs": 7, "simba.gamma": 0.9, "nnss.epochs": 9}
    assert for_method(overrides, "simba") == {"epochs": 7, "gamma": 0.9}
    assert for_method(overrides, "n4sid") == {"epochs": 5}
    assert for_method(overrides, "nnss", "nnss-ensemble") == {"epochs": 9}


def test_set_reaches_only_its_method_and_the_combination_of_it(small_data: Callable, tmp_path: Any) -> None:
    from nnss_cli.experiment.store import Store
    from nnss_cli.experiment.sweep import plan

    methods = [METHODS[name] for name in ("nnss", "nnss-ensemble", "nnss-paper", "simba")]
    overrides = {"epochs": 5, "window": 12, "nnss.epochs": 7, "nnss.hidden": (3,), "simba.epochs": 9}
    found = plan(Store(tmp_path, "small", "strict"), small_data(K=300), methods, [2], [0], overrides, False).todo
    assert {spec.method: spec.settings["epochs"] for spec in found} == {
        "nnss": 7, "nnss-ensemble": 7, "nnss-paper": 5, "simba": 9,
    }  # fmt: skip
    assert {spec.method for spec in found if tuple(spec.settings.get("hidden", ())) == (3,)} == {
        "nnss",
        "nnss-ensemble",
    }


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (
            ["--methods", "n4sid", "--hidden", "5"],
            ["--hidden: no chosen method (n4sid) has the option 'hidden'; nnss, nnss-paper have it"],
        ),
        (["--methods", "nnss", "--kernel", "dc"], ["--kernel: no chosen method (nnss)", "ssregest has it"]),
        (["--methods", "n4sid", "--lambda", "1"], ["--lambda: no chosen method", "'consistency'"]),
        (["--methods", "nnss-paper", "--recipe", "best"], ["--recipe: no chosen method (nnss-paper)", "; nnss has it"]),
        (["--methods", "n4sid", "--engine", "auto"], ["--engine: no chosen method"]),
        (["--set", "simba"], ["expected METHOD.OPTION=VALUE", "'simba'"]),
        (["--set", "simba.epochs"], ["expected METHOD.OPTION=VALUE"]),
        (["--set", "sinba.epochs=3"], ["unknown method 'sinba': did you mean 'simba'?", "nnss", "ssregest"]),
        (["--set", "simba.epoch=3"], ["unknown option 'epoch' of simba: did you mean 'epochs'?", "learning_rate"]),
        (["--set", "simba.epochs=many"], ["--set simba.epochs: expected a whole number, found 'many'"]),
        (["--set", "n4sid.horizon=far"], ["unknown horizon 'far'", "matlab, auto"]),
        (["--set", "ssregest.kernel=rbf"], ["unknown kernel 'rbf'", "tc, dc, ss"]),
        (
            ["--methods", "n4sid", "--set", "simba.epochs=3"],
            ["--set simba.epochs: simba is not among the methods that run (n4sid)"],
        ),
        (["--set", "simba.epochs=3", "simba.epochs=4"], ["--set simba.epochs is given twice"]),
        (["--epochs", "3", "--set", "simba.epochs=4"], ["--epochs and --set simba.epochs are the same option"]),
        (["--set", "nnss-ensemble.epochs=4"], ["nnss-ensemble combines runs of nnss: --set nnss.epochs=4"]),
    ],
)  # fmt: skip
def test_mistakes_with_options_are_one_line(args: list[str], words: list[str], nnss: Callable) -> None:
    outcome = nnss("compare", "twotank-sim", "--orders", "2", *args)
    assert outcome.code == 2
    (line,) = outcome.err.strip().splitlines()
    for word in words:
        assert word in line


@pytest.mark.system
def test_options_of_members_count_for_their_combination(nnss: Callable) -> None:
    outcome = nnss(
        "compare", "twotank-sim", "--orders", "2", "--seeds", "1", "--jobs", "1", "--methods", "nnss-ensemble",
        "--hidden", "3", "--set", "nnss.epochs=1",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err


def test_one_option_in_two_commands(nnss: Callable) -> None:
    """--set is the flag: the run is the same one."""
    call = ("train", "twotank-sim", "--order", "2", "--method", "ssest")
    assert nnss(*call, "--feedthrough", "yes").code == 0
    assert "finished already" in nnss(*call, "--set", "ssest.feedthrough=yes").out
    refused = nnss(*call, "--set", "ssest.feedthrough=no")
    assert "feedthrough yes instead of no" in refused.err


def test_a_searched_recipe_without_a_flag_of_its_own_can_be_trained() -> None:
    from nnss_cli.commands.options import as_command_line

    line = as_command_line({"epochs": 3, "improvement": 0.1, "consistency": 0.5})
    assert line == "--epochs 3 --set nnss.improvement=0.1 --lambda 0.5"
