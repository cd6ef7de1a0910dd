"""Files out of zips and folders: what is taken, what is refused, in how much memory."""

import bz2
import io
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets import archive
from nnss_cli.datasets.archive import holds_files, pack, take

from nnss_cli.errors import InputError

WANTED = (("a.mat",), ("b.csv", "b.mat"))
NAMES = st.text("abcdefgh.", min_size=1, max_size=8).filter(lambda name: name.strip("."))


def write_zip(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as target:
        for name, content in members.items():
            target.writestr(name, content)
    return path


@given(files=st.dictionaries(NAMES, st.binary(max_size=60), min_size=1, max_size=4))
def test_what_is_packed_is_taken_out_again(files: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("zip") / "x.zip"
    path.write_bytes(pack(files))
    assert holds_files(path)
    distinct = {name for name in files if [other.casefold() for other in files].count(name.casefold()) == 1}
    for name in distinct:
        assert take(path, ((name,),)) == (files[name],)
    assert pack(files) == path.read_bytes()
    with zipfile.ZipFile(path) as by_zipfile:
        assert {info.filename: by_zipfile.read(info) for info in by_zipfile.infolist()} == files


@pytest.mark.parametrize("folder", ["", "Files/", "a/b/c/", "Files\\"])
def test_a_file_is_found_in_any_folder_of_a_zip_and_in_any_case(folder: str, tmp_path: Path) -> None:
    path = write_zip(tmp_path / "x.zip", {f"{folder}A.MAT": b"1", f"{folder}B.mat": b"2", "read.me": b"3"})
    assert take(path, WANTED) == (b"1", b"2")


def test_the_first_of_the_names_and_the_least_deep_of_a_name_count(tmp_path: Path) -> None:
    members = {"old/copies/a.mat": b"deep", "b.mat": b"second", "x/b.csv": b"first", "x/a.mat": b"1"}
    path = write_zip(tmp_path / "x.zip", members)
    assert take(path, WANTED) == (b"1", b"first")


def test_a_folder_gives_its_own_files_only(tmp_path: Path) -> None:
    (tmp_path / "a.mat").write_bytes(b"1")
    (tmp_path / "b.mat").write_bytes(b"2")
    (tmp_path / "deeper").mkdir()
    (tmp_path / "deeper" / "b.csv").write_bytes(b"3")
    assert holds_files(tmp_path)
    assert take(tmp_path, WANTED) == (b"1", b"2")
    (tmp_path / "b.mat").unlink()
    with pytest.raises(InputError, match="expected b.csv or b.mat in it, found no file of that name"):
        take(tmp_path, WANTED)


@pytest.mark.parametrize("name", ["../a.mat", "x/../../a.mat", "/a.mat", "..\\a.mat", "a.mat/", "__MACOSX/._a.mat"])
def test_what_points_out_of_the_zip_or_is_no_file_is_not_taken(name: str, tmp_path: Path) -> None:
    path = write_zip(tmp_path / "x.zip", {name: b"" if name.endswith("/") else b"1"})
    with pytest.raises(InputError, match="x.zip': expected a.mat in it, found no file of that name"):
        take(path, (("a.mat",),))
    assert [p.name for p in tmp_path.rglob("*")] == ["x.zip"]


def test_a_file_over_the_limit_is_refused_before_it_is_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "LIMIT", 1_000_000)
    path = write_zip(tmp_path / "x.zip", {"a.mat": bytes(50_000_000)})
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "a.mat").write_bytes(bytes(1_000_001))
    for place in (path, tmp_path / "folder"):
        tracemalloc.start()
        with pytest.raises(InputError, match="expected a.mat of at most 1000000 bytes, found"):
            take(place, (("a.mat",),))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 500_000


def test_a_zip_that_lies_about_a_size_unpacks_no_more_than_that(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "x.zip", {"a.mat": bytes(50_000_000)})
    content = bytearray(path.read_bytes())
    for place in (22, content.index(b"PK\x01\x02") + 24):  # the size, where the file stands and in the directory
        assert struct.unpack_from("<I", content, place) == (50_000_000,)
        struct.pack_into("<I", content, place, 1000)
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(InputError, match="x.zip' is not a readable zip"):
        take(path, (("a.mat",),))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1_000_000


def test_rare_compressions_are_refused_since_their_blocks_are_unbounded(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "x.zip", {"a.mat": bytes(1000)}, zipfile.ZIP_BZIP2)
    assert len(bz2.compress(bytes(50_000_000))) < 1000  # what a kilobyte of it may become
    with pytest.raises(InputError, match="expected a.mat stored or deflated, found compression 12"):
        take(path, (("a.mat",),))


def encrypted(content: bytes) -> bytes:
    changed = bytearray(content)
    for start, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        changed[changed.index(start) + flags] |= 1
    return bytes(changed)


@pytest.mark.parametrize("damage", [lambda c: c[:-30], lambda c: c[:4], encrypted, lambda c: c[:60] + bytes(80)])
def test_a_damaged_zip_is_one_line(damage: Callable[[bytes], bytes], tmp_path: Path) -> None:
    path = tmp_path / "x.zip"
    path.write_bytes(damage(pack({"a.mat": bytes(range(200))})))
    assert holds_files(path)
    with pytest.raises(InputError, match="x.zip' is not a readable zip") as caught:
        take(path, (("a.mat",),))
    assert "\n" not in str(caught.value)


@given(flips=st.lists(st.tuples(st.integers(4, 10_000), st.integers(1, 255)), min_size=1, max_size=5))
def test_no_damage_gives_other_contents_or_another_error(
    flips: list[tuple[int, int]], tmp_path_factory: pytest.TempPathFactory
) -> None:
    buffer = io.BytesIO()
    original = bytes(range(256)) * 4
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as target:
        target.writestr("Files/a.mat", original)
    content = bytearray(buffer.getvalue())
    for place, change in flips:
        content[4 + place % (len(content) - 4)] ^= change
    path = tmp_path_factory.mktemp("zip") / "x.zip"
    path.write_bytes(content)
    try:
        found = take(path, (("a.mat",),))
    except InputError:
        return
    assert found == (original,)


def test_a_file_that_is_no_zip_holds_no_files(tmp_path: Path) -> None:
    for name, content in (("empty", b""), ("text", b"PK of something"), ("mat", b"MATLAB 5.0 MAT-file")):
        (tmp_path / name).write_bytes(content)
        assert not holds_files(tmp_path / name)
    assert not holds_files(tmp_path / "missing")
