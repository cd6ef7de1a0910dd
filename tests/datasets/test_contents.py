"""Only the published samples pass, in whatever form, from wherever: the real files and made-up ones."""

import gzip
import hashlib
import io
import struct
import zipfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import scipy.io
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as array_strategy
from nnss_cli.datasets.benchmark import Samples, Source, check_contents, samples_hash
from nnss_cli.datasets.catalog import (
    cascaded_tanks,
    ced,
    emps,
    load,
    powerplant,
    robotarm,
    silverbox,
    twotank,
    wiener_hammerstein,
)
from nnss_cli.datasets.download import fetch, install
from nnss_cli.datasets.record import FloatArray

from nnss_cli.errors import DataUnavailable, InputError

Arrays = dict[str, FloatArray]

REAL = {twotank: "TwoTanksMatlab.mat", robotarm: "RobotArm.mat", powerplant: "powerplant.dat"}
OFFICIAL = {
    cascaded_tanks: "dataBenchmark.mat",
    ced: "DATAUNIF.MAT",
    emps: "",
    silverbox: "SNLS80mV.csv",
    wiener_hammerstein: "WienerHammerBenchMark.mat",
}


def write_matlab(path: Path, arrays: Arrays) -> None:
    scipy.io.savemat(path, arrays)


def write_table(separator: str, pack: bool) -> Callable[[Path, Arrays], None]:
    def write(path: Path, arrays: Arrays) -> None:
        u, y = arrays.values()
        columns = np.column_stack([np.arange(1, len(u) + 1), u, y])
        text = "\n".join(separator.join(map(repr, row)) for row in columns.tolist()) + "\n"
        path.write_bytes(gzip.compress(text.encode()) if pack else text.encode())

    return write


def write_rows(path: Path, arrays: Arrays) -> None:
    """MATLAB's row vectors."""
    scipy.io.savemat(path, {name: values.T for name, values in arrays.items()})


def write_two_columns(path: Path, arrays: Arrays) -> None:
    """A header, a comma at the end of every line and an empty one at the end."""
    lines = ['"V1","V2",', *(f"{u!r},{y!r}," for u, y in np.column_stack(list(arrays.values())).tolist()), "", ""]
    path.write_text("\n".join(lines))


def write_two_files(path: Path, arrays: Arrays) -> None:
    """Arrays named "vir of x.mat" in files of a zip."""
    files: dict[str, Arrays] = {}
    for name, values in arrays.items():
        variable, _, file = name.partition(" of ")
        files.setdefault(file, {})[variable] = values
    with zipfile.ZipFile(path, "w") as target:
        for file, variables in files.items():
            content = io.BytesIO()
            scipy.io.savemat(content, variables)
            target.writestr(f"EMPS/{file}", content.getvalue())


@dataclass(frozen=True)
class Form:
    """One form in which a benchmark's file comes."""

    module: ModuleType
    names: tuple[str, ...]
    """The arrays in it."""
    write: Callable[[Path, Arrays], None]


FORMS = {
    "twotankdata.mat": Form(twotank, ("u", "y"), write_matlab),
    "TwoTanksMatlab.mat": Form(twotank, ("U", "Y", "U_val", "Y_val"), write_matlab),
    "RobotArm.mat": Form(robotarm, ("U", "Y", "U_val", "Y_val"), write_matlab),
    "robotarmdata.mat": Form(robotarm, ("ue", "ye", "uv1", "yv1", "uv3", "yv3"), write_matlab),
    "robotarmdata.mat without uv3": Form(robotarm, ("ue", "ye", "uv1", "yv1"), write_matlab),
    "powerplant.dat": Form(powerplant, (powerplant.INPUTS, powerplant.OUTPUTS), write_table("\t  ", False)),
    "powerplant.csv": Form(powerplant, (powerplant.INPUTS, powerplant.OUTPUTS), write_table(",", False)),
    "powerplant.dat.gz": Form(powerplant, (powerplant.INPUTS, powerplant.OUTPUTS), write_table(" ", True)),
    "dataBenchmark.mat": Form(cascaded_tanks, tuple(cascaded_tanks.CONTENTS), write_matlab),
    "DATAUNIF.MAT": Form(ced, tuple(ced.CONTENTS), write_matlab),
    "EMPS.zip": Form(emps, tuple(emps.CONTENTS), write_two_files),
    "SNLS80mV.csv": Form(silverbox, ("V1", "V2"), write_two_columns),
    "SNLS80mV.mat": Form(silverbox, ("V1", "V2"), write_rows),
    "WienerHammerBenchMark.mat": Form(wiener_hammerstein, tuple(wiener_hammerstein.CONTENTS), write_matlab),
}
VERIFIED = [
    (form, name)
    for form in FORMS
    if form != "SNLS80mV.csv"  # a second each: it has a test of its own
    for name in FORMS[form].names
    if name not in ("uv3", "yv3")
]


def zeroed(a: FloatArray) -> FloatArray:
    return np.zeros_like(a)


def negated(a: FloatArray) -> FloatArray:
    return -a


def tenfold(a: FloatArray) -> FloatArray:
    return 10 * a


def reversed_in_time(a: FloatArray) -> FloatArray:
    return a[::-1].copy()


def one_bit(a: FloatArray) -> FloatArray:
    """The last bit of one sample, which no statistic shows and decimation may drop."""
    changed = a.copy()
    changed[7, -1] = np.nextafter(changed[7, -1], np.inf)
    return changed


def two_swapped(a: FloatArray) -> FloatArray:
    """Mean, deviation and histogram stay as they are."""
    changed = a.copy()
    changed[[3, 4]] = changed[[4, 3]]
    return changed


TAMPERED = [zeroed, negated, tenfold, reversed_in_time, one_bit, two_swapped]


def made_up(form: str, monkeypatch: pytest.MonkeyPatch) -> Arrays:
    """Arrays of the form's shapes, which from now on are the published record."""
    module, names = FORMS[form].module, FORMS[form].names
    random = np.random.default_rng(7)
    arrays = {name: random.standard_normal(module.CONTENTS[name].shape) for name in names}
    published = {
        name: replace(samples, sha256=samples_hash(arrays[name]) if name in arrays and samples.sha256 else None)
        for name, samples in module.CONTENTS.items()
    }
    monkeypatch.setattr(module, "CONTENTS", published)
    return arrays


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_the_published_samples_is_accepted(
    form: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, own_cache: Path
) -> None:
    path = tmp_path / "given"
    FORMS[form].write(path, made_up(form, monkeypatch))
    benchmark = FORMS[form].module.BENCHMARK
    assert install(benchmark, path).parent == own_cache
    assert load(benchmark.name, benchmark.protocols[-1]).tests


@pytest.mark.parametrize("tamper", TAMPERED)
@pytest.mark.parametrize(("form", "name"), VERIFIED)
def test_a_change_in_any_array_is_refused_and_named_wherever_the_file_comes_from(
    form: str, name: str, tamper: Callable, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, own_cache: Path
) -> None:
    arrays = made_up(form, monkeypatch)
    benchmark = FORMS[form].module.BENCHMARK
    arrays[name] = tamper(arrays[name])
    path = tmp_path / benchmark.sources[0].filename
    FORMS[form].write(path, arrays)
    with pytest.raises(InputError) as caught:
        install(benchmark, path)
    message = str(caught.value)
    assert message.startswith(f"'{path}' is not the expected record: {name} differs (sha256")
    assert message.count("differs") == 1
    assert message.endswith("fetch it again with --force, or give the original file with --from")
    with pytest.raises(DataUnavailable, match="is not the expected record"):
        fetch(benchmark, mirror=str(tmp_path), offline=True)
    assert not own_cache.exists()


@pytest.mark.parametrize("form", ["twotankdata.mat", "RobotArm.mat", "powerplant.dat.gz", "EMPS.zip"])
def test_an_original_source_and_the_cache_are_trusted_no_more_than_a_mirror(
    form: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    own_cache: Path,
    serve: Callable[[Path], AbstractContextManager[str]],
) -> None:
    module = FORMS[form].module
    arrays = made_up(form, monkeypatch)
    good, bad = tmp_path / "good", tmp_path / "bad"
    FORMS[form].write(good, arrays)
    FORMS[form].write(bad, {name: one_bit(a) for name, a in arrays.items()})
    with serve(tmp_path) as base:
        with pytest.raises(DataUnavailable, match="is not the expected record"):
            fetch(replace(module.BENCHMARK, sources=(Source(f"{base}/bad"),)))
        assert not own_cache.exists()
        path = fetch(replace(module.BENCHMARK, sources=(Source(f"{base}/bad"), Source(f"{base}/good"))))
    load(module.BENCHMARK.name)
    # an entry written past nnss, its hash file with it
    content = bad.read_bytes()
    path.write_bytes(content)
    unpacked = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    path.with_name(path.name + ".sha256").write_text(hashlib.sha256(unpacked).hexdigest())
    for use in (lambda: load(module.BENCHMARK.name), lambda: fetch(module.BENCHMARK, offline=True)):
        with pytest.raises(InputError, match=r"is not the expected record.*--force"):
            use()


def test_the_message_names_all_that_differ(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    arrays = made_up("TwoTanksMatlab.mat", monkeypatch)
    path = tmp_path / "x.mat"
    write_matlab(path, arrays | {"Y": -arrays["Y"], "U_val": -arrays["U_val"]})
    with pytest.raises(InputError, match=r"record: Y differs \(.*…\), U_val differs \(") as caught:
        twotank.load(path, "paper")
    assert str(caught.value).count("differs") == 2


@pytest.mark.parametrize("form", [form for form in FORMS if form.endswith(".mat")])
def test_another_shape_is_refused_and_named(form: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    arrays = made_up(form, monkeypatch)
    path = tmp_path / "x.mat"
    for name, whole in arrays.items():
        across = () if form == "SNLS80mV.mat" else (whole.T,)  # a row or a column, as MATLAB has it
        for other in (whole[:-1], *across, np.column_stack([whole, whole]), whole[:0]):
            write_matlab(path, arrays | {name: other})
            with pytest.raises(InputError, match=rf"'.*x.mat': expected {name} of shape .*, found \("):
                FORMS[form].module.load(path, "")


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["ue", "yv1", "uv3", "yv3"])
def test_samples_that_are_not_finite_are_refused_and_named(
    name: str, value: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    arrays = made_up("robotarmdata.mat", monkeypatch)
    arrays[name][13] = value  # one that decimation drops
    path = tmp_path / "x.mat"
    write_matlab(path, arrays)
    with pytest.raises(InputError, match=f"x.mat': expected finite numbers in {name}"):
        robotarm.load(path, "paper")


def test_what_cannot_be_verified_is_said_to_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    arrays = made_up("robotarmdata.mat", monkeypatch)
    path = tmp_path / "x.mat"
    write_matlab(path, arrays | {"yv3": -arrays["yv3"]})
    for protocol in ("paper", "strict"):
        dataset = robotarm.load(path, protocol)
        np.testing.assert_array_equal(dataset.tests["test"][0].y, -arrays["yv3"][:-1:10][:-4])
        assert ["uv3, yv3" in note and "verify" in note for note in dataset.notes] == [True]
    write_matlab(path, {name: arrays[name] for name in ("ue", "ye", "uv1", "yv1")})
    assert not any("verify" in note for note in robotarm.load(path, "paper").notes)


@pytest.mark.parametrize(
    "variables",
    [
        {"u": "text", "y": np.zeros((3000, 1))},
        {"u": {"struct": 1.0}, "y": np.zeros((3000, 1))},
        {"u": np.zeros((3000, 1)) * 1j, "y": np.zeros((3000, 1))},
        {"u": np.zeros((2, 2, 2)), "y": np.zeros((3000, 1))},
        {"U": np.zeros((0, 0)), "Y": np.zeros((0, 0)), "U_val": np.zeros((1, 2)), "Y_val": np.zeros((1, 1))},
    ],
)
def test_other_types_of_variables_are_one_line(variables: dict, tmp_path: Path) -> None:
    path = tmp_path / "x.mat"
    scipy.io.savemat(path, variables)
    with pytest.raises(InputError, match="x.mat': expected ") as caught:
        twotank.load(path, "paper")
    assert "\n" not in str(caught.value)


def test_a_damaged_gzip_file_is_one_line(tmp_path: Path) -> None:
    packed = bytearray(gzip.compress(np.random.default_rng(0).bytes(5000)))
    path = tmp_path / "x.gz"
    for place in range(10, len(packed) - 8, 97):  # header, deflate stream, length and checksum
        damaged = packed.copy()
        damaged[place] ^= 0xFF
        path.write_bytes(damaged)
        with pytest.raises(InputError, match="x.gz"):
            powerplant.load(path, "paper")


# The real files, where they are


@pytest.mark.parametrize("module", REAL)
def test_the_references_are_the_real_files_hashes(module: ModuleType, mirror: Path) -> None:
    """By struct and hashlib, and by readers of their own."""
    if module is powerplant:
        table = [[float(x) for x in line.split()] for line in (mirror / REAL[module]).read_text().splitlines()]
        raw = {powerplant.INPUTS: [row[1:6] for row in table], powerplant.OUTPUTS: [row[6:9] for row in table]}
    else:
        raw = {n: a.tolist() for n, a in scipy.io.loadmat(mirror / REAL[module]).items() if not n.startswith("__")}
        if module is twotank:
            raw |= {"u": raw["U"] + raw["U_val"], "y": raw["Y"] + raw["Y_val"]}
        else:
            raw |= {"ue": raw["U"], "ye": raw["Y"], "uv1": raw["U_val"], "yv1": raw["Y_val"]}
    assert set(raw) >= {name for name, samples in module.CONTENTS.items() if samples.sha256}
    for name, samples in module.CONTENTS.items():
        if samples.sha256:
            assert (len(raw[name]), len(raw[name][0])) == samples.shape
            assert samples.sha256 == plain_hash(raw[name]), name


@pytest.mark.parametrize(
    ("form", "changed"),
    [
        ("TwoTanksMatlab.mat", {"U": zeroed, "U_val": zeroed}),
        ("TwoTanksMatlab.mat", {"Y_val": tenfold}),
        ("TwoTanksMatlab.mat", {"Y": reversed_in_time}),
        ("RobotArm.mat", {"U": negated, "U_val": negated}),
        ("RobotArm.mat", {"Y_val": one_bit}),
        ("powerplant.dat", {powerplant.INPUTS: zeroed}),
        ("powerplant.csv", {powerplant.OUTPUTS: two_swapped}),
        ("powerplant.dat.gz", {powerplant.INPUTS: one_bit}),
    ],
)
def test_a_tampered_real_file_stays_out(
    form: str, changed: dict[str, Callable], mirror: Path, tmp_path: Path, own_cache: Path
) -> None:
    module = FORMS[form].module
    arrays = module.read(mirror / REAL[module])
    path = tmp_path / module.BENCHMARK.sources[0].filename
    FORMS[form].write(path, arrays)
    module.load(path, "paper")  # it is only the change that is refused
    FORMS[form].write(path, arrays | {name: tamper(arrays[name]) for name, tamper in changed.items()})
    with pytest.raises(InputError, match="is not the expected record") as caught:
        install(module.BENCHMARK, path)
    assert [name for name in arrays if f"{name} differs" in str(caught.value)] == list(changed)
    with pytest.raises(DataUnavailable, match="is not the expected record"):
        fetch(module.BENCHMARK, mirror=str(tmp_path), offline=True)
    assert not own_cache.exists()


@pytest.mark.parametrize("module", OFFICIAL)
def test_the_official_references_are_the_real_files_hashes(module: ModuleType, official: Callable[[str], Path]) -> None:
    """By struct and hashlib, and by readers of their own."""
    folder = official(module.BENCHMARK.name)
    if module is silverbox:
        rows = [line.split(",") for line in (folder / OFFICIAL[module]).read_text().split()[1:]]
        raw = {"V1": [[float(row[0])] for row in rows], "V2": [[float(row[1])] for row in rows]}
    elif module is emps:
        raw = {
            f"{n} of {file}": a.tolist() for file in emps.FILES for n, a in scipy.io.loadmat(folder / file).items()
            if isinstance(a, np.ndarray)
        }  # fmt: skip
    else:
        raw = {n: a.tolist() for n, a in scipy.io.loadmat(folder / OFFICIAL[module]).items() if not n.startswith("__")}
    for name, samples in module.CONTENTS.items():
        assert (len(raw[name]), len(raw[name][0])) == samples.shape
        assert samples.sha256 == plain_hash(raw[name]), name


def test_a_change_of_the_last_digit_in_the_silverboxs_table_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    arrays = made_up("SNLS80mV.csv", monkeypatch)
    path = tmp_path / "SNLS80mV.csv"
    write_two_columns(path, arrays)
    lines = path.read_text().split("\n")
    u, y, _ = lines[50_000].split(",")
    lines[50_000] = f"{u},{y[:-1]}{(int(y[-1]) + 5) % 10},"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match=r"is not the expected record: V2 differs \(") as caught:
        silverbox.load(path, "official")
    assert str(caught.value).count("differs") == 1


@pytest.mark.parametrize("content", [b"", b"V1;V2\n1;2\n", b'"V1","V2",\n0.1,0.2,\n0.1,x,\n', b'"V1","V2",\n0.1\n'])
def test_a_table_that_is_not_the_silverboxs_is_one_line(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "SNLS80mV.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"SNLS80mV.csv'.*(: expected MATLAB|line [23]: expected V1, V2, found)") as e:
        silverbox.load(path, "official")
    assert "\n" not in str(e.value)


# The hash


def plain_hash(samples: list[list[float]]) -> str:
    """`samples_hash`, sample by sample."""
    digest = hashlib.sha256(f"({len(samples)}, {len(samples[0])})".encode())
    for row in samples:
        for value in row:
            digest.update(struct.pack("<d", 0.0 if value == 0 else value))
    return digest.hexdigest()


MATRICES = array_strategy(
    np.float64,
    st.tuples(st.integers(1, 6), st.integers(1, 4)),
    elements=st.floats(-1e300, 1e300),
)


@given(MATRICES)
def test_the_hash_is_of_shape_and_samples_in_order(a: np.ndarray) -> None:
    assert samples_hash(a) == plain_hash(a.tolist())


@given(MATRICES)
def test_storage_does_not_change_the_hash(a: np.ndarray) -> None:
    for same in (np.asfortranarray(a), a.astype(">f8"), np.repeat(a, 2, axis=0)[::2], np.where(a == 0, -0.0, a)):
        assert samples_hash(same) == samples_hash(a)


def test_integers_hash_as_the_numbers_they_are() -> None:
    a = np.arange(256).reshape(64, 4)
    assert samples_hash(a.astype(np.uint8)) == samples_hash(a.astype(np.float32)) == samples_hash(a.astype(np.float64))


@given(MATRICES, st.data())
def test_another_sample_or_shape_changes_the_hash(a: np.ndarray, data: st.DataObject) -> None:
    place = tuple(data.draw(st.integers(0, size - 1)) for size in a.shape)
    other = a.copy()
    other[place] = np.nextafter(other[place], np.inf)
    assert samples_hash(other) != samples_hash(a)
    if a.shape[0] != a.shape[1]:
        assert samples_hash(a.reshape(a.shape[::-1])) != samples_hash(a)


def test_an_array_without_a_reference_cannot_pass_by_oversight() -> None:
    with pytest.raises(KeyError):
        check_contents(Path("x"), {"extra": np.zeros((1, 1))}, {"u": Samples((1, 1), None)})
