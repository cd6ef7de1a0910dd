"""The docs folder as a site, and the tutorial, run from its first cell to its last: what `make docs` asks for."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    """Every link is followed, every page is in the navigation, every name of the reference is found."""
    pytest.importorskip("mkdocs", reason="pip install 'nnss[docs]'")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    reference = (tmp_path / "site" / "reference.html").read_text(encoding="utf-8")
    for name in ("api.compare", "api.fit", "trained.model.TrainedModel.linearise", "export.write.export"):
        assert f'id="nnss_cli.{name}"' in reference, name
    for page in (tmp_path / "site").glob("*.html"):
        assert "fonts.googleapis" not in page.read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_tutorial_runs(tmp_path: Path) -> None:
    nbformat = pytest.importorskip("nbformat", reason="pip install 'nnss[docs]'")
    client = pytest.importorskip("nbclient", reason="pip install 'nnss[docs]'")
    notebook = nbformat.read(ROOT / "docs" / "tutorial.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)  # they would go stale
    client.NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    last = notebook.cells[-1].outputs
    assert "control.nlsys: largest error" in str(last)
    assert (tmp_path / "python" / "model.py").exists()
