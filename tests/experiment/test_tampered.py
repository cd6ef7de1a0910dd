"""Files on disk that were tampered with: one line that names the file, or no difference; never a traceback."""

import json
import random
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.catalog import load

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.schema import check_signals
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import load_model, select
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import write_tensors

VALUES: list[Any] = [None, True, -1, 0, 1.5, 1e400, "", "x", "../..", [], [1], {}, {"a": 1}, [[[]]], 10**30]


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """A run of n4sid, and a model of nnss beside it."""
    store = Store(tmp_path_factory.mktemp("sound"), "twotank-sim", "strict")
    dataset = load(store.dataset, store.protocol)
    (spec,) = plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo
    assert execute(spec, dataset, store).status == "ok"
    model = NNSS(
        Architecture(2, 1, 1, hidden=(4,), encoder=(2,)),
        dataset.fitting.scaling,
        dataset.fitting.channels,
        dataset.fitting.Ts,
    )
    model.initialise(np.random.default_rng(0))
    model.save(store.folder / "runs" / "nnss-n2-s0")
    return store


def copied(store: Store, tmp_path: Path) -> Store:
    shutil.copytree(store.out, tmp_path / "out")
    return Store(tmp_path / "out", store.dataset, store.protocol)


def places(content: Any, path: tuple = ()) -> list[tuple]:
    """The path of every value within."""
    inner = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    return [path] * bool(path) + [found for key, value in inner for found in places(value, (*path, key))]


def changed(content: Any, path: tuple, value: Any) -> Any:
    """A copy with another value there; without it where the value is `...`."""
    copy = json.loads(json.dumps(content))
    place = copy
    for key in path[:-1]:
        place = place[key]
    if value is ...:
        del place[path[-1]]
    else:
        place[path[-1]] = value
    return copy


def mutations(content: Any, count: int, draw: random.Random) -> list[bytes]:
    """Values of other types in any place, places left out, deep nesting, and flipped or missing bytes."""
    found, whole = [], json.dumps(content).encode()
    for _ in range(count):
        if draw.random() < 0.6:
            path = draw.choice(places(content))
            found.append(json.dumps(changed(content, path, draw.choice([*VALUES, ...]))).encode())
        elif draw.random() < 0.5:
            at = draw.randrange(len(whole))
            found.append(whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :])
        else:
            found.append(whole[: draw.randrange(len(whole))])
    return [*found, b"[" * 100_000, b'{"a":' * 100_000, b"null", b"[]", b"\xff\xfe", b""]


def one_line(act: Callable[[], object], name: str) -> bool:
    """Whether it was refused, and then with one line that names the file."""
    message = ""
    try:
        act()
    except InputError as error:
        message = str(error) or "nothing was said"
    assert not message or (name in message and len(message.splitlines()) == 1), message
    return bool(message)


def test_a_tampered_run_is_one_line(sound: Store, tmp_path: Path) -> None:
    store = copied(sound, tmp_path)
    path = store.folder / "runs" / "n4sid-n2-s0" / "run.json"
    content = json.loads(path.read_text())
    refused = 0
    texts = mutations(content, 400, random.Random(0))
    for text in texts:
        path.write_bytes(text)
        refused += one_line(store.results, "n4sid-n2-s0")
    assert refused > len(texts) / 2


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("spec", "order"), None, "spec.order: Input should be a valid integer, found None"),
        (("spec", "order"), 3, "expected twotank-sim/strict/n4sid-n2-s0 in this folder, found .*n4sid-n3-s0"),
        (("spec", "dataset"), "other", "expected twotank-sim/strict/n4sid-n2-s0 in this folder, found other/strict"),
        (("status",), "fine", "status: Input should be 'ok', 'diverged'"),
        (("status",), "diverged", "reason: expected one where"),
        (("scores",), [], "scores: expected some"),
        (("scores", 0, "rmse"), -1.0, "not negative"),
        (("scores", 0, "rmse"), float("nan"), "finite"),
        (("scores", 0, "output"), "y7", "expected one for each output"),
        (("scores", 0), ..., "'val'|scores"),
        (("channels",), {"outputs": 3}, "outputs: Input should be a valid tuple|inputs: Field required"),
        (("channels", "outputs"), ["a", "b"], "channels: a unit each"),
        (("provenance", "numpy"), [], "provenance.numpy"),
        (("unknown",), 1, "unknown: Unexpected keyword argument"),
    ],
)
def test_what_is_wrong_is_named(path: tuple, value: Any, words: str, sound: Store, tmp_path: Path) -> None:
    store = copied(sound, tmp_path)
    file = store.folder / "runs" / "n4sid-n2-s0" / "run.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(changed(content, path, value)))
    if path == ("scores", 0):  # a split without scores is sound where the data had none
        assert len(store.results()[0].scores) == len(content["scores"]) - 1
        return
    with pytest.raises(InputError, match=rf"n4sid-n2-s0.*({words}).*remove the folder") as told:
        store.results()
    assert len(str(told.value).splitlines()) == 1


DAMAGED: list[tuple[Callable[[str], str], str]] = [
    (lambda text: text[:30], """, found '{ "spec": { """),
    (lambda _: "", "(Invalid JSON: EOF while parsing a value at line 1 column 0, found '')"),
    (lambda _: "3", "(Input should be an object, found 3)"),
    (
        lambda text: re.sub(r'"nrmse": [^,]+', '"nrmse": NaN', text),
        ", nrmse nan, fit_percent ",
    ),
]


@pytest.mark.parametrize(("damage", "words"), DAMAGED)
def test_a_damaged_run_is_told_in_plain_words(
    damage: Callable[[str], str], words: str, sound: Store, tmp_path: Path
) -> None:
    store = copied(sound, tmp_path)
    path = store.folder_of("n4sid-n2-s0") / "run.json"
    path.write_text(damage(path.read_text()))
    (line,) = store.read().faults.values()
    assert words in line
    assert line.count("run.json") == 1
    assert "b'" not in line
    assert "(: " not in line


def test_a_run_in_anothers_folder_is_told_once(sound: Store, tmp_path: Path) -> None:
    store = copied(sound, tmp_path)
    store.folder_of("n4sid-n2-s0").rename(store.folder_of("n4sid-n2-s1"))
    (line,) = store.read(touch=False).faults.values()
    assert line.count("is not a finished run of this version") == 1
    assert line.count("run it again") == 1
    assert (
        "(spec: expected twotank-sim/strict/n4sid-n2-s1 in this folder, found twotank-sim/strict/n4sid-n2-s0)" in line
    )


@pytest.mark.parametrize("label", ["n4sid-n2-s0", "nnss-n2-s0"])
def test_a_tampered_model_is_one_line(label: str, sound: Store, tmp_path: Path) -> None:
    store = copied(sound, tmp_path)
    folder = store.folder / "runs" / label
    content = json.loads((folder / "model.json").read_text())
    for text in mutations(content, 200, random.Random(1)):
        (folder / "model.json").write_bytes(text)
        one_line(lambda: load_model(folder), label)
    (folder / "model.json").write_text(json.dumps(content))
    whole, draw = (folder / "model.safetensors").read_bytes(), random.Random(2)
    for _ in range(100):
        at = draw.randrange(min(len(whole), 600))
        (folder / "model.safetensors").write_bytes(
            whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :]
        )
        one_line(lambda: load_model(folder), label)


def test_scores_that_disagree_with_the_signals_are_named(sound: Store, tmp_path: Path) -> None:
    store = copied(sound, tmp_path)
    result = store.results()[0]
    signals = store.signals(result.spec)
    path = store.run_folder(result.spec) / "signals.safetensors"
    for name, other in (
        ("test/0/y_sim", signals["test/0/y_sim"] * 1.0001),
        ("test/0/y_sim", signals["test/0/y_sim"] * 1e300),
        ("test/0/y", signals["test/0/y"][:-1]),
        ("test/0/x", signals["test/0/x"].astype(int)),
        ("Ts", np.zeros(1)),
    ):
        write_tensors(path, signals | {name: other})
        with pytest.raises(InputError, match=r"signals.safetensors' disagrees with the run.json beside it"):
            store.signals(result.spec)
    write_tensors(path, {name: array for name, array in signals.items() if not name.startswith("val/")})
    with pytest.raises(InputError, match="val: no signals"):
        store.signals(result.spec)
    write_tensors(path, signals)
    check_signals(result, store.signals(result.spec))


@pytest.mark.parametrize(
    "more", [("--hidden", "100000000"), ("--encoder", "100000", "100000"), ("--hidden", *["20000"] * 2)]
)
def test_sizes_are_bounded_before_memory_is_taken(more: tuple[str, ...], nnss: Callable) -> None:
    told = nnss("train", "twotank-sim", "--order", "2", *more)
    assert told.code == 2
    assert "expected at most 100,000,000 weights, found" in told.err
    assert len(told.err.splitlines()) == 1
    assert not Path("results").exists()


def test_no_tampered_file_stops_what_is_read_beside_it(sound: Store, tmp_path: Path) -> None:
    """Whatever is in a run's files, the others are read; it is one line, or as good as it was."""
    store = copied(sound, tmp_path)
    whole = store.read().results
    other = store.folder / "runs" / "n4sid-n2-s1"
    shutil.copytree(store.folder / "runs" / "n4sid-n2-s0", other)
    content = json.loads((other / "run.json").read_text())
    content["spec"]["seed"] = 1
    (other / "run.json").write_text(json.dumps(content))
    assert len(store.read().results) == 2
    signals, draw = (other / "signals.safetensors").read_bytes(), random.Random(3)
    files = [("run.json", text) for text in mutations(content, 150, random.Random(4))]
    for _ in range(150):
        at = draw.randrange(len(signals) if draw.random() < 0.5 else 1500)  # its head is there
        files.append(
            ("signals.safetensors", signals[:at] + bytes([signals[at] ^ 1 << draw.randrange(8)]) + signals[at + 1 :])
        )
    refused = 0
    for name, damaged in files:
        before = (other / name).read_bytes()
        (other / name).write_bytes(damaged)
        found = store.read()
        assert [r for r in found.results if r.spec.seed == 0] == whole
        for line in found.faults.values():
            assert "n4sid-n2-s1" in line
            assert len(line.splitlines()) == 1
        refused += len(found.faults)
        (other / name).write_bytes(before)
    assert refused > len(files) / 2
