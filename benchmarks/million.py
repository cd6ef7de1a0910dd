"""A study of a million runs: scores in Parquet shards and one index, beside a folder for each run as today.

python benchmarks/million.py --runs 1000000

The shards are simulated: rows of made-up scores with the strings of a real run.json, written and read back as a table
would. The folders are real, but few, and multiplied. Needs pyarrow: pip install 'nnss[parquet]'.
"""

import argparse
import hashlib
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq

SHARD = 10_000  # runs of a file: what one worker finishes before it writes
BLOCK = 4096  # bytes that a file system gives at least to a file
SPLITS = ("train", "val", "test")


def folders(count: int, folder: Path) -> tuple[int, int, int]:
    """Of a real run: bytes of run.json, bytes on disk, entries of the file system (files and their folder)."""
    line = ["compare", "twotank-sim", "--methods", "n4sid", "--orders", *map(str, range(1, count + 1)), "--quiet"]
    subprocess.run([sys.executable, "-m", "nnss_cli", *line, "--out", str(folder)], check=True)
    files = list(folder.glob("*/*/runs/[!.]*/*"))
    sizes = [path.stat().st_size for path in files]
    taken = sum(-(-size // BLOCK) * BLOCK for size in sizes) + BLOCK * count
    texts = sum(path.stat().st_size for path in files if path.name == "run.json")
    return texts // count, taken // count, len(files) // count + 1


def shard(first: int, text: str, draw: np.random.Generator) -> pa.Table:
    """The rows of `SHARD` runs: one for each split."""
    seeds = np.repeat(np.arange(first, first + SHARD), len(SPLITS))
    rows = len(seeds)
    return pa.table(
        {
            "method": pa.array(["nnss"] * rows).dictionary_encode(),
            "order": pa.array(np.full(rows, 3, np.int16)),
            "seed": pa.array(seeds.astype(np.int32)),
            "split": pa.array(list(SPLITS) * SHARD).dictionary_encode(),
            "rmse": pa.array(draw.lognormal(-4, 0.3, rows)),
            "status": pa.array(["ok"] * rows).dictionary_encode(),
            "made": pa.array([text] * rows).dictionary_encode(),  # settings, provenance, channels: a few per study
        }
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1_000_000)
    given = parser.parse_args()
    draw = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text_bytes, taken, entries = folders(4, folder / "few")
        text = next(folder.glob("few/*/*/runs/*/run.json")).read_text(encoding="utf-8")
        shards = folder / "shards"
        shards.mkdir()
        index = {}
        began = time.perf_counter()
        for first in range(0, given.runs, SHARD):
            path = shards / f"{first // SHARD:06d}.parquet"
            pq.write_table(shard(first, text, draw), path, compression="zstd")
            index[path.name] = {
                "runs": [first, first + SHARD], "sha256": hashlib.sha256(path.read_bytes()).hexdigest()
            }  # fmt: skip
        (shards / "index.json").write_text(json.dumps(index), encoding="utf-8")
        wrote = time.perf_counter() - began
        size = sum(path.stat().st_size for path in shards.iterdir())
        began = time.perf_counter()
        intact = all(
            hashlib.sha256((shards / file).read_bytes()).hexdigest() == entry["sha256"] for file, entry in index.items()
        )
        checked = time.perf_counter() - began
        began = time.perf_counter()
        columns = pads.dataset(shards, exclude_invalid_files=True).to_table(["order", "split", "rmse"]).to_pandas()
        medians = columns.groupby(["order", "split"], observed=True)["rmse"].median()
        read = time.perf_counter() - began
    print(
        f"{given.runs:,} runs, a folder each: {given.runs * entries:,} entries of the file system, "
        f"{given.runs * taken / 1e9:.0f} GB of which run.json {given.runs * text_bytes / 1e9:.1f} GB"
    )
    print(
        f"in {len(index)} shards of {SHARD:,} runs: {size / 1e6:.0f} MB of scores; written in {wrote:.1f} s, "
        f"checked ({'intact' if intact else 'DAMAGED'}) in {checked:.1f} s, "
        f"medians of {len(medians)} splits in {read:.1f} s, "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB at most"
    )


if __name__ == "__main__":
    main()
