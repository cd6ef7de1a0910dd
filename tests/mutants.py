"""Mutation testing on a sample: how many small faults in the code the tests notice.

    python tests/mutants.py --sample 200 --seed 0
    python tests/mutants.py --only nnss_cli/report/figures.py --sample 40 --seed 1

First the mutants of mutants.toml, which a review made by hand; then a seeded sample of those that Cosmic Ray's
operators make, as many from each folder. A mutant is killed when a test fails, or when the tests take longer than
`timeout`. Everything happens in a copy in a temporary folder, so an interruption leaves the working tree as it was.

Cosmic Ray's own `exec` would take hours: it runs one command for every mutant, in a new process. Here a mutant is
judged by the tests of its folder that ran the mutated statement (by coverage), the fastest first, up to the first that
fails, in a fork of a process that has loaded the libraries. mutmut 3 cannot be used: it knows a function by its file's
path, and datasets/record.py is imported as nnss_cli.datasets.record.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import hashlib
import json
import os
import re
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from random import Random
from typing import Any

from mutants_looks import Place, places_of_looks, sets_looks
from mutants_pytest import Judging, Tracing, run_tests
from real_files import folder_of_files

ROOT = Path(__file__).parents[1]
KEPT = ROOT / ".mutants"  # what ran where, and the survivors

# group → what is mutated, folders or files, and the tests that judge it
GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "datasets": (("datasets",), ("tests/datasets", "tests/experiment/test_runs.py")),
    "experiment": (("nnss_cli/experiment",), ("tests/experiment", "tests/report")),
    "report": (("nnss_cli/report",), ("tests/report", "tests/validation", "tests/experiment/test_inspection.py")),
    "training": (
        ("nnss_cli/training/attempt.py", "nnss_cli/training/fit.py", "nnss_cli/training/start.py"), ("tests/training",),
    ),
}  # fmt: skip
STRUCTURE = "tests/test_structure.py::test_dataclasses_are_frozen"  # judges every group
INSIDE = ("datasets", "baselines")  # top-level folders that are installed inside the package

LIBRARIES = (
    "numpy", "pandas", "pydantic", "scipy.linalg", "scipy.optimize", "scipy.signal", "scipy.stats", "tabulate", "torch",
    "typer", "matplotlib.backends.backend_agg", "matplotlib.pyplot",
)  # fmt: skip
"""Loaded before the fork: each mutant would spend seconds on them."""

# On numbers >>, |, & and ^ in the place of arithmetic raise a TypeError: kills that say nothing of the tests.
TRIVIAL = re.compile(r"BinaryOperator_(Add|Sub|Mul|Div|FloorDiv|Mod|Pow)_(RShift|LShift|BitOr|BitAnd|BitXor)")


@dataclass(frozen=True)
class Mutant:
    """A file with one change."""

    name: str
    """file:operator:number, or the name that mutants.toml gives."""
    file: str
    """Path in the repository."""
    text: str
    """The file's content with the change."""
    line: int
    """Line of the change, from 1."""
    tests: tuple[str, ...]
    """Files and folders whose tests judge it, or the one test that must."""
    named: bool = False
    """Whether it is of mutants.toml: judged by the test named there."""
    looks: bool = False
    """Whether it changes a figure's looks alone, by the rule of mutants_looks.py."""

    def diff(self) -> list[str]:
        """The change as a unified diff without context."""
        old, new = (ROOT / self.file).read_text(encoding="utf-8").splitlines(), self.text.splitlines()
        return list(difflib.unified_diff(old, new, self.file, self.name, lineterm="", n=0))


@dataclass(frozen=True)
class Verdict:
    """What the tests made of a mutant."""

    mutant: Mutant
    """Which."""
    killer: str
    """The test that failed, "timeout", or "" for a survivor."""
    seconds: float
    """Wall time [s]."""


@dataclass
class Map:
    """What the tests run where nothing is mutated."""

    seconds: dict[str, float] = field(default_factory=dict)
    """Time of each test [s]."""
    lines: dict[str, dict[int, set[str]]] = field(default_factory=dict)
    """Tests that ran a line, by file and line; a test file's name for a fixture that it shares."""


def installed(file: str) -> str:
    """Where a file of the repository stands in the copy, which is laid out as the package is installed."""
    return f"nnss_cli/{file}" if file.split("/")[0] in INSIDE else file


def copy_of_package(root: Path) -> None:
    """Package, tests, what they read and pytest's settings; dates are kept, for the compiled files that go by them."""
    ignore = shutil.ignore_patterns("__pycache__")
    for folder in ("nnss_cli", *INSIDE, "tests", "docs"):
        shutil.copytree(ROOT / folder, root / installed(folder), ignore=ignore)
    shutil.copy2(ROOT / "pyproject.toml", root)


def named_mutants() -> list[Mutant]:
    """Those of mutants.toml.

    Raises:
        SystemExit: the text to change does not occur exactly once: the code has moved on.
    """
    found = []
    for entry in tomllib.loads((ROOT / "tests/mutants.toml").read_text(encoding="utf-8"))["mutant"]:
        source = (ROOT / entry["file"]).read_text(encoding="utf-8")
        if source.count(entry["old"]) != 1:
            raise SystemExit(f"mutants.toml: {entry['name']}: expected the old text once in {entry['file']}")
        at = source[: source.index(entry["old"])].count("\n") + 1
        text = source.replace(entry["old"], entry["new"])
        found.append(Mutant(entry["name"], entry["file"], text, at, (entry["test"],), named=True))
    return found


def places(file: str) -> dict[Place, list[tuple[str, int]]]:
    """Start and end of everything in a file that an operator changes → each operator and its count of occurrences."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator, operator_names

    nodes = list(ast_nodes(get_ast_from_path(ROOT / file)))
    found: dict[Any, list[tuple[str, int]]] = {}
    for name in operator_names():
        operator = get_operator(name)
        if operator.arguments() or TRIVIAL.search(name):
            continue
        positions = (place for node in nodes for place in operator().mutation_positions(node))
        for occurrence, place in enumerate(positions):
            found.setdefault(place, []).append((name, occurrence))
    return found


def mutant_of(file: str, operator: str, occurrence: int, place: Place) -> Mutant | None:
    """The mutant, or None where there is none or it is the same program: an annotation's text is never evaluated.

    Nor is `is` for `==` beside a literal another program.
    """
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    source = (ROOT / file).read_text(encoding="utf-8")
    try:
        text = mutate_code(source, get_operator(operator)(), occurrence)
    except AttributeError:  # Cosmic Ray's exception replacer stumbles over a dotted name
        return None
    try:
        if text is None or _program(text) == _program(source):
            return None
    except SyntaxError:
        return None
    tests = next(tests for paths, tests in GROUPS.values() if file.startswith(paths))
    name = f"{file}:{operator.rpartition('/')[2]}:{occurrence}"
    looks = sets_looks(place, places_of_looks(source))
    return Mutant(name, file, text, place[0][0], tests, looks=looks)


def _program(text: str) -> str:
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            node.returns = None
        elif isinstance(node, ast.arg):
            node.annotation = None
        elif isinstance(node, ast.AnnAssign):
            node.annotation = ast.Constant(None)
        elif isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            node.ops = [_equality(*each) for each in zip(node.ops, sides, sides[1:], strict=False)]
    return ast.dump(tree)


def _equality(op: ast.cmpop, *sides: ast.expr) -> ast.cmpop:
    """`is` beside a literal word or whole number is `==`: CPython keeps one object of each such."""
    if any(isinstance(side, ast.Constant) and type(side.value) in (str, int) for side in sides):
        return {ast.Is: ast.Eq, ast.IsNot: ast.NotEq}.get(type(op), type(op))()
    return op


def sampled(group: str, count: int, seed: int) -> list[Mutant]:
    """A draw of a group's places, and at each one of its mutants: the many of `+` count no more than one."""
    paths = [ROOT / path for path in GROUPS[group][0]]
    files = [file for path in paths for file in ([path] if path.is_file() else sorted(path.glob("*.py")))]
    return drawn_from([str(file.relative_to(ROOT)) for file in files], count, f"{seed} {group}")


def drawn_from(files: Sequence[str], count: int, seed: str) -> list[Mutant]:
    """A draw of places of these files without replacement, and at each one of its mutants."""
    at = [(file, place, choices) for file in files for place, choices in sorted(places(file).items())]
    random = Random(seed)
    random.shuffle(at)
    drawn: list[Mutant] = []
    for file, place, choices in at:
        if len(drawn) == count:
            break
        mutant = mutant_of(file, *random.choice(choices), place)
        if mutant:
            drawn.append(mutant)
    return drawn


def found_again(name: str) -> Mutant:
    """The mutant of this name.

    Raises:
        SystemExit: there is none.
    """
    by_name = {mutant.name: mutant for mutant in named_mutants()}
    if name in by_name:
        return by_name[name]
    file, _, rest = name.partition(":")
    word, _, number = rest.partition(":")
    for place, choices in places(file).items() if (ROOT / file).is_file() else ():
        for operator, occurrence in choices:
            if (operator.rpartition("/")[2], str(occurrence)) == (word, number):
                mutant = mutant_of(file, operator, occurrence, place)
                if mutant:
                    return mutant
    raise SystemExit(f"no mutant is named '{name}'")


def mapped(root: Path, mutants: Sequence[Mutant]) -> Map:
    """What the tests that judge these mutants run; files of tests are not run again unless they or the code changed.

    Raises:
        SystemExit: a test fails where nothing is mutated.
    """
    common = [*(ROOT / "nnss_cli").rglob("*.py"), *(f for name in INSIDE for f in (ROOT / name).rglob("*.py"))]
    common += (ROOT / "tests").rglob("conftest.py")
    folders = sorted({test for mutant in mutants if not mutant.named for test in mutant.tests})
    files = sorted(
        {f for name in folders for f in ([ROOT / name] if name.endswith(".py") else (ROOT / name).glob("test_*.py"))}
    )
    files.append(ROOT / STRUCTURE.partition("::")[0])
    hashes = {str(f.relative_to(ROOT)): _hash([*common, f]) for f in files}
    kept_in = KEPT / "map.json"
    kept = json.loads(kept_in.read_text(encoding="utf-8")) if kept_in.is_file() else {}
    for file in [file for file in hashes if kept.get(file, {}).get("hash") != hashes[file]]:
        print(f"what {file} runs …", flush=True)
        result, log = root / "map.json", root / "log.txt"
        plugin = Tracing(root, [installed(path) for paths, _ in GROUPS.values() for path in paths], result)
        if run_tests(root, [STRUCTURE if STRUCTURE.startswith(file) else file], plugin, log, 3600, keep_compiled=True):
            raise SystemExit(f"tests fail where nothing is mutated:\n{log.read_text(encoding='utf-8')[-4000:]}")
        kept[file] = {"hash": hashes[file], **json.loads(result.read_text(encoding="utf-8"))}
        KEPT.mkdir(parents=True, exist_ok=True)
        kept_in.write_text(json.dumps(kept), encoding="utf-8")
    found = Map()
    for file in hashes:
        found.seconds |= kept[file]["seconds"]
        for path, lines in kept[file]["lines"].items():
            for line, tests in lines.items():
                found.lines.setdefault(path, {}).setdefault(int(line), set()).update(tests)
    return found


def _hash(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _functions(tree: ast.AST) -> Iterator[tuple[int, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            yield node.body[0].lineno, node.end_lineno or node.lineno


def _statement(tree: ast.AST, line: int) -> range:
    """Lines of the innermost statement around a line, of a compound one the head only."""
    best = range(line, line + 1)
    for node in ast.walk(tree):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno):
            body = getattr(node, "body", None)
            end = body[0].lineno if body else (node.end_lineno or node.lineno) + 1
            if line < end:
                best = range(node.lineno, end)  # ast.walk goes from the outer to the inner
    return best


def chosen_tests(mutant: Mutant, ran: Map) -> list[str]:
    """Tests that can tell a mutant of a function: they ran the statement. All of the folder outside of functions.

    So do those beside them that ran nothing of the file: a figure that one test draws and keeps is looked at by others.

    A statement that no test was seen to run may have run in a worker process: what ran its file judges it.
    """
    tree = ast.parse((ROOT / mutant.file).read_text(encoding="utf-8"))
    lines = ran.lines.get(installed(mutant.file), {})
    bodies = list(_functions(tree))

    def tests_of(numbers: Iterator[int] | range) -> set[str]:
        return {test for number in numbers for test in lines.get(number, ())}

    near = tests_of(number for first, last in bodies for number in range(first, last + 1))
    own = [t for t in ran.seconds if t == STRUCTURE or any(t.startswith((f"{f}/", f"{f}::")) for f in mutant.tests)]
    if any(first <= mutant.line <= last for first, last in bodies):
        seen = tests_of(_statement(tree, mutant.line)) or near
        files, touched = {test.partition("::")[0] for test in seen}, set().union(*lines.values())
        # what ran nothing of the mutated file may look at what a neighbour, or a fixture of both, has made
        own = [
            test for test in own
            if test in seen or test.partition("::")[0] in seen
            or (test.partition("::")[0] in files and test not in touched)
        ]  # fmt: skip
    return sorted(own, key=lambda test: (test != STRUCTURE and test not in near, ran.seconds[test]))


def judge(root: Path, mutant: Mutant, ran: Map) -> Verdict:
    """Run the tests on a mutant, up to the first that fails."""
    began = time.monotonic()
    target, result, log = root / installed(mutant.file), root / "killer.txt", root / "log.txt"
    tests = [] if mutant.named else chosen_tests(mutant, ran)
    if not (tests or mutant.named):
        return Verdict(mutant, "", 0.0)
    limit = 600.0 if mutant.named else 120 + 10 * sum(ran.seconds[test] for test in tests)
    args = ["-x", *(mutant.tests if mutant.named else sorted({test.partition("::")[0] for test in tests}))]
    result.unlink(missing_ok=True)
    target.write_text(mutant.text, encoding="utf-8")
    try:
        code = run_tests(root, args, Judging(tests, result, ran.seconds), log, limit, keep_compiled=False)
    finally:
        shutil.copy2(ROOT / mutant.file, target)
    if code >= 2 and not result.is_file() and mutant.named:
        raise SystemExit(f"{mutant.name}: {mutant.tests[0]} does not run:\n{log.read_text(encoding='utf-8')[-2000:]}")
    killer = result.read_text(encoding="utf-8") if result.is_file() else "the tests cannot be loaded"
    return Verdict(mutant, {0: "", -1: "timeout"}.get(code, killer), time.monotonic() - began)


def share(killed: int, count: int) -> str:
    """Killed of count with the exact (Clopper–Pearson) 95 % interval."""
    from scipy.stats import binomtest

    interval = binomtest(killed, count).proportion_ci(0.95)
    return f"{killed}/{count} killed, {killed / count:.1%} (95 % interval {interval.low:.1%} to {interval.high:.1%})"


def tell(group: str, verdicts: Sequence[Verdict]) -> None:
    """The share of a group, and that of its mutants that change more than a figure's looks."""
    rest = [v for v in verdicts if not v.mutant.looks]
    print(f"{group}: {share(sum(bool(v.killer) for v in verdicts), len(verdicts))}")
    if rest and len(rest) < len(verdicts):
        apart = len(verdicts) - len(rest)
        print(f"{group}, {apart} of looks apart: {share(sum(bool(v.killer) for v in rest), len(rest))}")


def load_libraries() -> None:
    """What the package and its tests load, once for all mutants; not the package itself."""
    for name in LIBRARIES:
        import_module(name)


def main() -> None:
    """Parse the command line, judge, tell."""
    parser = argparse.ArgumentParser(description="Mutation testing on a sample.")
    parser.add_argument("--sample", type=int, default=200, help="mutants, a quarter from each folder; 0 for none")
    parser.add_argument("--seed", type=int, default=0, help="of the draw")
    parser.add_argument("--mutant", nargs="*", default=[], help="judge these again, by the names in survivors.diff")
    parser.add_argument(
        "--only", nargs="*", default=[], help="draw from these files or groups alone, --sample from each"
    )
    parser.add_argument(
        "--tests", nargs="*", default=[], help="files of tests that judge alone: a lower bound, soon had"
    )
    options = parser.parse_args()
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that the copy is removed
    mirror = folder_of_files()
    if mirror:
        os.environ["NNSS_TEST_MIRROR"] = str(mirror)
    load_libraries()
    if options.mutant:
        groups = {"named on the command line": [found_again(name) for name in options.mutant]}
    elif options.only:
        seed = options.seed
        groups = {
            name: sampled(name, options.sample, seed)
            if name in GROUPS
            else drawn_from([name], options.sample, f"{seed} {name}")
            for name in options.only
        }
    else:
        groups = {"the review's": named_mutants()}
        for position, group in enumerate(GROUPS):
            count = (options.sample + position) // len(GROUPS)
            groups |= {group: sampled(group, count, options.seed)} if count else {}
    if options.tests:
        groups = {
            name: [mutant if mutant.named else replace(mutant, tests=tuple(options.tests)) for mutant in mutants]
            for name, mutants in groups.items()
        }
    began = time.monotonic()
    verdicts: dict[str, list[Verdict]] = {}
    with tempfile.TemporaryDirectory(prefix="nnss-mutants-") as temporary:
        root = Path(temporary).resolve()
        copy_of_package(root)
        drawn_mutants = [mutant for mutants in groups.values() for mutant in mutants if not mutant.named]
        ran = mapped(root, drawn_mutants) if drawn_mutants else Map()
        for group, mutants in groups.items():
            for mutant in mutants:
                verdict = judge(root, mutant, ran)
                verdicts.setdefault(group, []).append(verdict)
                word = f"killed by {verdict.killer}" if verdict.killer else "SURVIVED"
                word += " (looks)" * mutant.looks
                print(f"{verdict.seconds:6.1f} s  {mutant.name}: {word}", flush=True)
    survivors = [v.mutant for those in verdicts.values() for v in those if not v.killer]
    KEPT.mkdir(parents=True, exist_ok=True)
    lines = [line for mutant in survivors for line in (*mutant.diff(), "")]
    (KEPT / "survivors.diff").write_text("\n".join(lines), encoding="utf-8")
    print(f"\n{(time.monotonic() - began) / 60:.0f} min, seed {options.seed}")
    for group, those in verdicts.items():
        tell(group, those)
    drawn = [v for group, those in verdicts.items() if not options.mutant for v in those if not v.mutant.named]
    if drawn:
        tell("in all", drawn)
        print(f"by a timeout: {sum(v.killer.startswith('timeout') for v in drawn)}")
    print(f"survivors: {KEPT / 'survivors.diff'}")
    if any(mutant.named for mutant in survivors):
        raise SystemExit("a mutant of the review survived")


if __name__ == "__main__":
    main()
