"""Numbers of the page and where they come from. Nothing of nnss computes what is expected: run files and NumPy do."""

import html
import itertools
import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from safetensors.numpy import load_file

import nnss_cli.report
from nnss_cli.experiment.ablation import STUDIES

NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.]*[A-Za-z_])")
CONSTANTS = [95.0]  # the level that intervals hold at


class Tables(HTMLParser):
    """Caption, heads and cells of every table."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: list[dict[str, Any]] = []
        self.into: list[str] | None = None
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "table":
            self.tables.append({"caption": [""], "head": [], "rows": []})
        elif tag == "caption":
            self.into = self.tables[-1]["caption"]
        elif tag == "tr":
            self.tables[-1]["rows"].append([])
        elif tag in ("td", "th"):
            row = self.tables[-1]["rows"][-1]
            row.append("")
            self.into = row

    def handle_endtag(self, tag: str) -> None:
        if tag in ("td", "th", "caption"):
            self.into = None

    def handle_data(self, data: str) -> None:
        if self.into is not None:
            self.into[-1] += data


def tables_of(page: str) -> list[dict[str, Any]]:
    found = Tables(page).tables
    for table in found:
        table["caption"] = " ".join(table["caption"][0].split())
        table["head"], *table["rows"] = [[" ".join(cell.split()) for cell in row] for row in table["rows"]]
    return found


def strings(content: Any) -> set[str]:
    """Every text in a file."""
    if isinstance(content, dict):
        return set().union(*map(strings, content.values()), {str(key) for key in content})
    if isinstance(content, list):
        return set().union(*map(strings, content), {json.dumps(content, ensure_ascii=False)})
    return {content} if isinstance(content, str) else {json.dumps(content)}


def read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def errors_of(run: dict[str, Any], split: str) -> dict[str, float]:
    """Errors of a split by output, with both means where there are several."""
    own = [score for score in run["scores"] if score["split"] == split]
    found = {score["output"]: score["rmse"] for score in own}
    if len(run["channels"]["outputs"]) > 1:
        found |= (
            {"mean": sum(found.values()) / len(found), "nrmse": sum(s["nrmse"] for s in own) / len(own)} if own else {}
        )
    return found


def middle(values: list[float], q: float) -> float:
    """The quantile between order statistics, failed runs as ∞."""
    ordered = sorted(values)
    at = q * (len(ordered) - 1)
    low, high = ordered[math.floor(at)], ordered[math.ceil(at)]
    return low if at == math.floor(at) else math.inf if math.isinf(high) else low + (at - math.floor(at)) * (high - low)


def coverages(n: int) -> list[float]:
    """Of the median by the k-th smallest and largest of n."""
    tails = itertools.accumulate(math.comb(n, i) / 2**n for i in range(n // 2 + 1))
    return [1 - 2 * tail for tail in tails]


def expected(out: Path) -> tuple[np.ndarray, set[str]]:
    """All that may stand in a table: numbers, and texts that hold some."""
    numbers, texts = list(CONSTANTS), {name for study in STUDIES.values() for name in study}
    places = ("*/*/runs/*/run.json", "ablation/*/*/*/*/runs/*/run.json")
    for folder in {path.parents[2] for pattern in places for path in out.glob(pattern)}:
        texts |= {folder.name, folder.parent.name}
        groups: dict[tuple[str, int], list[dict[str, Any]]] = {}
        radii, norms = [], []
        for path in sorted(folder.glob("runs/*/run.json")):
            run = json.loads(path.read_text(encoding="utf-8"))
            groups.setdefault((run["spec"]["method"], run["spec"]["order"]), []).append(run)
            texts |= strings(run["provenance"]) | strings(run["spec"])
            numbers += [run["spec"]["order"], run["spec"]["seed"], run["fit_seconds"], run["epochs"]]
            numbers += [own[0] for name, own in run["history"].items() if len(own) == 1]
            for name, unit in zip(run["channels"]["outputs"], run["channels"]["output_units"], strict=True):
                texts.add(f"{name} [{unit}]")
            model = json.loads((path.parent / "model.json").read_text(encoding="utf-8"))
            numbers += [v for v in model.get("architecture", {}).values() if isinstance(v, int | float)]
            if (path.parent / "signals.safetensors").exists():
                signals = load_file(path.parent / "signals.safetensors")
                norms += [np.linalg.norm(x, axis=1).max() for name, x in signals.items() if name.endswith("/x")]
            if model["kind"] == "linear":
                radii.append(np.abs(np.linalg.eigvals(load_file(path.parent / "model.safetensors")["A"])).max())
        numbers += [*radii, *norms, sum(map(len, groups.values()))]
        test: dict[int, list[list[float]]] = {}
        for (_, order), runs in groups.items():
            n = len(runs)
            stressed = [read(path) for path in folder.glob(f"runs/*-n{order}-s*/stress.json")]
            numbers.append(sum(one["unbounded"] for one in stressed))
            numbers += [n, sum(run["status"] == "ok" for run in runs)]
            numbers += [100 * share for share in coverages(n)]
            times = [run["fit_seconds"] for run in runs]
            numbers += [middle(times, 0.5), sum(times), middle([run["epochs"] for run in runs], 0.5)]
            numbers += [float(run["provenance"]["peak memory [MB]"]) for run in runs]
            for split in ("train", "val", "test"):
                outputs = next(errors_of(run, split) for run in runs if run["status"] == "ok")
                for output in outputs:
                    values = [errors_of(run, split).get(output, math.inf) for run in runs]
                    numbers += [*values, *(middle(values, q) for q in (0.25, 0.5, 0.75))]
                    fits = [
                        next(
                            (s["fit_percent"] for s in run["scores"] if (s["split"], s["output"]) == (split, output)),
                            -math.inf,
                        )
                        for run in runs
                    ]
                    numbers.append(-middle([-fit for fit in fits], 0.5))
            ranked = [
                sum(s["nrmse"] for s in run["scores"] if s["split"] == "test") / len(run["channels"]["outputs"])
                if run["scores"] else math.inf
                for run in runs
            ]  # fmt: skip
            test.setdefault(order, []).append(ranked)
            numbers += [*ranked, middle(ranked, 0.5)]
        for rivals in test.values():
            ends = [[*values, middle(values, 0.5)] for values in rivals]
            numbers += [a / b for first in ends for second in ends for a in first for b in second if b > 0]
            numbers += [100 * (1 - a / b) for values in ends for a in values for b in values if b > 0]
            shares = [[1.0, *coverages(len(values))] for values in rivals]
            numbers += [100 * (a + b - 1) for one in shares for two in shares for a in one for b in two]
    return np.array(sorted(value for value in numbers if math.isfinite(value))), texts


def is_found(token: str, numbers: np.ndarray) -> bool:
    """Whether a number stands for one of these, rounded to its last digit: the fourth of what is 10,000 or more."""
    digits, _, exponent = token.lower().lstrip("+-").partition("e")
    whole, _, fraction = digits.partition(".")
    place = int(exponent or 0) - len(fraction) if fraction or exponent else max(0, len(whole) - 4)
    return bool((np.abs(numbers - float(token)) <= 0.5 * 10.0**place * (1 + 1e-6)).any())


def printed() -> list[float]:
    """Values of the paper and of the models that its authors released, with the bounds of these medians."""
    folder = Path(nnss_cli.report.__file__).parent
    numbers = list(pd.read_csv(folder / "paper_tables.csv")["rmse"])
    for row in pd.read_csv(folder / "released_models.csv").itertuples():
        half = 1.57 * (row.q3 - row.q1) / math.sqrt(row.seeds)
        numbers += [row.median, row.median - half, row.median + half]
    return numbers


def missing(out: Path, page: str) -> list[str]:
    numbers, texts = expected(out)
    theirs = np.array(printed())
    verdict = re.findall(r'<ul class="verdict">(.*?)<p>', page, re.DOTALL)
    boxes = re.findall(r"<title>(.*?: median .*?)</title>", page)
    assert verdict
    assert boxes
    cells = [
        (f"{table['caption']:.40}: {head}", cell)
        for table in tables_of(page)
        for row in table["rows"]
        for head, cell in zip(table["head"], row, strict=True)
        if not is_theirs(head, cell, dict(zip(table["head"], row, strict=True)), theirs)
    ]
    cells += [("verdict", html.unescape(re.sub(r"<.*?>", "", text))) for text in verdict]
    cells += [("box", text) for text in boxes]
    return [
        f"{where}: {cell}"
        for where, cell in cells
        if cell not in texts and not all(is_found(token, numbers) for token in NUMBER.findall(cell))
    ]


def is_theirs(head: str, cell: str, row: dict[str, str], theirs: np.ndarray) -> bool:
    """Whether a cell of a comparison is the paper's own number, what ours is above it, or a row's place."""
    if head == "difference":
        ours = float(row.get("ours, chosen as the paper does") or row["ours: median"])
        return abs(100 * (ours / float(row.get("paper") or row["released: median"]) - 1) - float(cell.split()[0])) < 0.6
    published = row.get("source", "").startswith("[")  # a note's number, in a table by place
    if head == "place" or (head == "source" and published):
        return True
    own = ("RMSE", "interval") if published else ("paper", "released: median", "its interval")
    return head in own and all(is_found(token, theirs) for token in NUMBER.findall(cell))
