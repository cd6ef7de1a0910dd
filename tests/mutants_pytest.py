"""pytest as mutants.py needs it: in a fork of a process that has loaded the libraries, with two plugins."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


def run_tests(root: Path, args: Sequence[str], plugin: Any, log: Path, timeout: float, keep_compiled: bool) -> int:
    """pytest in a fork of this process, in a group that ends with it; −1 after `timeout` seconds or an alarm."""
    import pytest

    child = os.fork()
    if child == 0:
        code = 3
        try:
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.chdir(root)
            stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(stream, 1)
            os.dup2(stream, 2)
            sys.path[0] = os.environ["PYTHONPATH"] = str(root)
            # A mutant may have the size and second of another: nothing compiled of it may be kept.
            if not keep_compiled:
                sys.dont_write_bytecode, os.environ["PYTHONDONTWRITEBYTECODE"] = True, "1"
            sys.modules["__main__"] = types.ModuleType("__main__")  # workers must not load this file
            del sys.modules["real_files"]  # the copy's
            code = int(
                pytest.main(["-q", "-m", "not slow", "--tb=short", "-p", "no:cacheprovider", *args], plugins=[plugin])
            )
        finally:
            sys.stdout.flush()
            os._exit(code)
    try:
        ends = time.monotonic() + timeout
        while time.monotonic() < ends:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                code = os.waitstatus_to_exitcode(status)
                return -1 if code == -signal.SIGALRM else code
            time.sleep(0.02)
        return -1
    finally:
        try:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
        except (ProcessLookupError, ChildProcessError):
            pass


class Tracing:
    """pytest plugin: how long each test takes, and which lines it runs."""

    def __init__(self, root: Path, mutated: Sequence[str], result: Path) -> None:
        """Write to `result` what runs of `mutated`: files or folders in `root`."""
        self.root, self.mutated, self.result = root, mutated, result
        self.seconds: dict[str, float] = {}

    def pytest_sessionstart(self) -> None:
        import coverage

        include = [str(self.root / path) + ("" if path.endswith(".py") else "/*") for path in self.mutated]
        self.coverage = coverage.Coverage(data_file=None, include=include, config_file=False, messages=False)
        self.coverage.start()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.coverage.switch_context(nodeid)

    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> None:
        if fixturedef.scope != "function":
            self.coverage.switch_context(fixturedef.baseid)

    def pytest_runtest_call(self, item: Any) -> None:
        self.coverage.switch_context(item.nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        self.coverage.stop()
        data = self.coverage.get_data()
        lines = {
            str(Path(file).relative_to(self.root)): {
                line: [c for c in contexts if c] for line, contexts in data.contexts_by_lineno(file).items()
            }
            for file in data.measured_files()
        }
        self.result.write_text(json.dumps({"seconds": self.seconds, "lines": lines}), encoding="utf-8")


class Judging:
    """pytest plugin: these tests in this order, an alarm for each, and the name of the one that fails."""

    def __init__(
        self, order: Sequence[str], result: Path, seconds: Mapping[str, float] = types.MappingProxyType({})
    ) -> None:
        """A test that takes ten times its `seconds`, and a minute more, ends everything: it hangs."""
        self.order = {test: position for position, test in enumerate(order)}
        self.result, self.seconds = result, seconds

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        signal.setitimer(signal.ITIMER_REAL, 60 + 10 * self.seconds[nodeid] if nodeid in self.seconds else 0)

    def pytest_runtest_logfinish(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, 0)

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        if self.order:
            config.hook.pytest_deselected(items=[item for item in items if item.nodeid not in self.order])
            items[:] = sorted((i for i in items if i.nodeid in self.order), key=lambda item: self.order[item.nodeid])

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            self.result.write_text(report.nodeid, encoding="utf-8")
