"""Disturb sweeps at random and at each phase, many times; write what came of it into docs/reliability.md.

python tests/soak.py --kills 50 --times 20
"""

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import sweep_faults as faults

PAGE = Path(__file__).parents[1] / "docs" / "reliability.md"
BEGIN, END = "<!-- written by `make soak` -->", "<!-- end of what `make soak` writes -->"
RUNS = 40
SWEEP = {"seeds": RUNS, "hold": "fit", "seconds": 0.3}


def finished(out: Path) -> dict[str, bytes]:
    """run.json of each finished run."""
    return {path.parent.name: path.read_bytes() for path in out.glob(f"{faults.RECORD}/runs/*/run.json")}


def unreadable(runs: dict[str, bytes]) -> int:
    """How many of them are no whole JSON."""
    count = 0
    for content in runs.values():
        try:
            json.loads(content)
        except ValueError:
            count += 1
    return count


def kill_at_random(folder: Path, kills: int, draw: random.Random) -> Counter[str]:
    """Kill -9 parent, worker or both of sweeps of 40 runs, call the same command again until each is done."""
    method = faults.write_method(folder)
    undisturbed = folder / "undisturbed"
    subprocess.run(faults.command(method, undisturbed, **SWEEP), check=True, capture_output=True)
    expected = faults.table(undisturbed)
    count: Counter[str] = Counter()
    while count["kills"] < kills:
        count["sweeps"] += 1
        out = folder / f"sweep-{count['sweeps']}"
        line = faults.command(method, out, "--retry-failed", **SWEEP)
        code: int | None = 1
        while code != 0:
            process = faults.start(line)
            time.sleep(draw.uniform(0.5, 3.0))
            while process.poll() is None and count["kills"] < kills:
                target = draw.choice(["parent", "worker", "both"])
                before = finished(out)
                faults.send(process, target, signal.SIGKILL)
                count["kills"] += 1
                count[target] += 1
                time.sleep(draw.uniform(0.8, 3.0) if target == "worker" else 0.2)
                count["lost"] += sum(finished(out).get(name) != content for name, content in before.items())
            ended = faults.ending(process, 60 if process.poll() is None and count["kills"] >= kills else 30)
            code = ended.code
            count["hangs"] += code is None
            count["orphans"] += len(ended.left)
            after = finished(out)
            count["unreadable"] += unreadable(after)
        rows = faults.table(out)
        keys = [tuple(row[:7]) for row in rows]
        count["duplicated"] += len(keys) - len(set(keys))
        count["tables that differ"] += rows != expected
        count["left over"] += len(faults.leftovers(out))
        print(dict(count), flush=True)
    return count


def signals_at_phases(folder: Path, times: int) -> dict[str, Counter[str]]:
    """Each signal to each target in each phase, so many times."""
    method = faults.write_method(folder)
    found: dict[str, Counter[str]] = {}
    for index in range(times):
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL):
            for target in ("parent", "worker", "group"):
                for phase in ("start", "compile", "fit", "write"):
                    place = Path(tempfile.mkdtemp(dir=folder))
                    ended = faults.disturbed(method, place / "out", place / "marks", phase, target, number)
                    count = found.setdefault(f"{number.name} to {target}", Counter())
                    count["tries"] += 1
                    count["hangs"] += ended.code is None
                    count["processes left"] += len(ended.left)
                    count["unreadable"] += unreadable(finished(place / "out"))
                    count["tracebacks"] += phase != "start" and "Traceback" in ended.err
                    wanted = {0} if target == "worker" else {130}
                    if number == signal.SIGKILL and target != "worker":
                        wanted = {-number}
                    if phase == "start":  # before our code is loaded Python's defaults hold
                        wanted |= {-number, 130, 1}
                    count["other exit codes"] += ended.code not in wanted
                    if ended.code not in wanted:
                        print(number.name, target, phase, ended, flush=True)
                    count["slowest"] = max(count["slowest"], round(1000 * ended.seconds) if target != "worker" else 0)
        print(f"round {index + 1} of {times}", flush=True)
    return found


def page(kills: Counter[str], phases: dict[str, Counter[str]], times: int) -> str:
    """The figures in words."""
    zero = ("lost", "duplicated", "unreadable", "hangs", "orphans", "tables that differ", "left over")
    told = ", ".join(f"{kills[name]} {name}" for name in zero)
    lines = [
        f"*{kills['kills']} random kill -9* ({kills['parent']} of the parent, {kills['worker']} of a worker, "
        f"{kills['both']} of both) over {kills['sweeps']} sweeps of {RUNS} runs, each taken up again by the same "
        f"command until it was done: {told}; rmse.csv is compared, times apart, with that of an undisturbed sweep.",
        "",
        f"*Each signal in each phase* (start, compile, fit, write), {times} times each:",
        "",
        "| signal and target | tries | hangs | processes left | unreadable runs | tracebacks | other exit codes "
        "| slowest end |",
        "|:--|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name, count in phases.items():
        cells = [
            count[key] for key in ("tries", "hangs", "processes left", "unreadable", "tracebacks", "other exit codes")
        ]
        slowest = f"{count['slowest'] / 1000:.1f} s" if "worker" not in name else "goes on"
        lines.append(f"| {name} | {' | '.join(map(str, cells))} | {slowest} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50, help="random kills")
    parser.add_argument("--times", type=int, default=20, help="each signal, target and phase so many times")
    parser.add_argument("--seed", type=int, default=0, help="of the random kills")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        kills = kill_at_random(folder, given.kills, random.Random(given.seed))
        phases = signals_at_phases(folder, given.times)
    text = page(kills, phases, given.times)
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    _, _, tail = rest.partition(END)
    PAGE.write_text(f"{head}{BEGIN}\n\n{text}\n\n{END}{tail}", encoding="utf-8")
    print(text)
    faults_found = sum(
        kills[key] for key in ("lost", "duplicated", "unreadable", "hangs", "orphans", "tables that differ")
    )
    faults_found += sum(
        c[key] for c in phases.values() for key in ("hangs", "processes left", "unreadable", "tracebacks")
    )
    sys.exit(1 if faults_found else 0)


if __name__ == "__main__":
    main()
