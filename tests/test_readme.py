"""README's lines for SLURM: the arguments exist, and a job starts a worker as `--executor dask` wants it."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_slurm_jobs_start_one_worker_of_one_thread() -> None:
    jobqueue = pytest.importorskip("dask_jobqueue")
    (block,) = re.findall(r"```python\n(import subprocess\n.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    (made,) = re.findall(r"^cluster = (SLURMCluster\(.*\))$", block, re.MULTILINE)
    with eval(made, {"SLURMCluster": jobqueue.SLURMCluster}) as cluster:
        script = cluster.job_script()
        assert cluster.scheduler_address.startswith("tcp://")
        assert "cluster.scale(jobs=" in block
        assert hasattr(cluster, "scale")
        assert "cluster.scheduler_address" in block
    for line in ("#SBATCH -n 1", "#SBATCH --cpus-per-task=1", "#SBATCH --mem=4G", "#SBATCH -t 12:00:00"):
        assert line in script.splitlines()
    assert re.search(r"distributed\.cli\.dask_worker tcp://\S+ .*--nthreads 1 ", script)
    assert "--nworkers" not in script
