"""The real records and the embedded plant, split as DESIGN.md says."""

from pathlib import Path

import numpy as np
import pytest
import scipy.io
from nnss_cli.datasets.catalog import powerplant, robotarm, simulated, twotank
from nnss_cli.datasets.record import Dataset

from nnss_cli.errors import InputError


def lengths(dataset: Dataset) -> dict[str, list[int]]:
    return {split: [len(record) for record in records] for split, records in dataset.splits().items()}


def test_two_tank_paper(mirror: Path) -> None:
    dataset = twotank.load(mirror / "TwoTanksMatlab.mat", "paper")
    (train,) = dataset.fitting.train
    assert lengths(dataset) == {"train": [1500], "val": [500], "test": [1500]}
    np.testing.assert_allclose(dataset.fitting.scaling.y_mean, 0.26023431757, rtol=1e-10)
    np.testing.assert_allclose(dataset.fitting.scaling.y_std, 0.16901727635, rtol=1e-10)
    assert train.y[-1] == train.y[-2]
    np.testing.assert_array_equal(dataset.fitting.val[0].y, dataset.tests["test"][0].y[:500])


def test_two_tank_strict_is_disjoint(mirror: Path) -> None:
    dataset = twotank.load(mirror / "TwoTanksMatlab.mat", "strict")
    assert lengths(dataset) == {"train": [1500], "val": [500], "test": [1000]}
    raw = scipy.io.loadmat(mirror / "TwoTanksMatlab.mat")
    np.testing.assert_array_equal(dataset.tests["test"][0].y, raw["Y_val"])
    np.testing.assert_array_equal(dataset.fitting.val[0].y, raw["Y"][1500:])


def test_two_tank_in_matlabs_own_form(mirror: Path, tmp_path: Path) -> None:
    raw = scipy.io.loadmat(mirror / "TwoTanksMatlab.mat")
    path = tmp_path / "twotankdata.mat"
    u = np.concatenate([raw["U"], raw["U_val"]]).astype(float)
    scipy.io.savemat(path, {"u": u, "y": np.concatenate([raw["Y"], raw["Y_val"]])})
    assert (
        twotank.load(path, "paper").fingerprint() == twotank.load(mirror / "TwoTanksMatlab.mat", "paper").fingerprint()
    )


def test_robot_arm_paper(mirror: Path) -> None:
    dataset = robotarm.load(mirror / "RobotArm.mat", "paper")
    assert lengths(dataset) == {"train": [1980], "val": [1980]}
    np.testing.assert_allclose(dataset.fitting.scaling.y_mean, 0.0474385245, rtol=1e-8)
    np.testing.assert_allclose(dataset.fitting.scaling.y_std, 20.8438684339, rtol=1e-11)
    assert dataset.fitting.Ts == pytest.approx(0.005)
    assert any("lacks" in note for note in dataset.notes)


def test_robot_arm_strict_halves_the_validation_record(mirror: Path) -> None:
    dataset = robotarm.load(mirror / "RobotArm.mat", "strict")
    assert lengths(dataset) == {"train": [1980], "val": [990], "test": [990]}
    (papers,) = robotarm.load(mirror / "RobotArm.mat", "paper").fitting.val
    np.testing.assert_array_equal(dataset.fitting.val[0].y, papers.y[:990])
    np.testing.assert_array_equal(dataset.tests["test"][0].y, papers.y[990:])
    assert any("not strict" in note for note in dataset.notes)


def test_robot_arm_with_the_papers_test_record(mirror: Path, tmp_path: Path) -> None:
    raw = scipy.io.loadmat(mirror / "RobotArm.mat")
    complete = {"ue": raw["U"], "ye": raw["Y"], "uv1": raw["U_val"], "yv1": raw["Y_val"]}
    complete |= {"uv3": raw["U"][::-1].copy(), "yv3": raw["Y"][::-1].copy()}
    path = tmp_path / "robotarmdata.mat"
    scipy.io.savemat(path, complete)
    paper, strict = robotarm.load(path, "paper"), robotarm.load(path, "strict")
    assert lengths(paper) == {"train": [1980], "val": [1980], "test": [1980]}
    assert lengths(strict) == {"train": [1980], "val": [990], "test": [1980]}
    assert all("verify" in note for note in paper.notes + strict.notes)  # these uv3, yv3 are none: none can tell


def test_power_plant(mirror: Path) -> None:
    paper = powerplant.load(mirror / "powerplant.dat", "paper")
    strict = powerplant.load(mirror / "powerplant.dat", "strict")
    table = np.loadtxt(mirror / "powerplant.dat")
    assert lengths(paper) == {"train": [100], "val": [49], "test": [50]}
    assert lengths(strict) == {"train": [100], "val": [50], "test": [50]}
    np.testing.assert_allclose(paper.fitting.scaling.y_std, table[:, 6:9].std(axis=0, ddof=1))
    np.testing.assert_allclose(strict.fitting.scaling.u_mean, table[:100, 1:6].mean(axis=0))
    np.testing.assert_array_equal(paper.tests["test"][0].u, table[149:199, 1:6])


def test_power_plant_with_commas_and_packed(mirror: Path, tmp_path: Path) -> None:
    import gzip

    table = np.loadtxt(mirror / "powerplant.dat")
    path = tmp_path / "powerplant.csv.gz"
    text = "\n".join(",".join(map(str, row)) for row in table)
    path.write_bytes(gzip.compress(text.encode()))
    assert (
        powerplant.load(path, "paper").fingerprint()
        == powerplant.load(mirror / "powerplant.dat", "paper").fingerprint()
    )


def test_every_change_of_a_sample_is_noticed(mirror: Path, tmp_path: Path) -> None:
    raw = scipy.io.loadmat(mirror / "RobotArm.mat")
    raw["Y"][1000] += 1.0
    path = tmp_path / "RobotArm.mat"
    scipy.io.savemat(path, {name: raw[name] for name in ("U", "Y", "U_val", "Y_val")})
    with pytest.raises(InputError, match="not the expected record"):
        robotarm.load(path, "paper")


@pytest.mark.parametrize("module", [twotank, robotarm, powerplant])
@pytest.mark.parametrize("content", [b"", b"not a data file\n", b"MATLAB 5.0 MAT-file" + bytes(200), b"\x1f\x8bbroken"])
def test_wrong_files_are_one_line(module: object, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "file.mat"
    path.write_bytes(content)
    with pytest.raises(InputError, match="file.mat") as caught:
        module.load(path, "paper")  # type: ignore[attr-defined]
    assert "\n" not in str(caught.value)


def test_embedded_plant_is_seeded_and_physical() -> None:
    first, second = (simulated.load(None, "paper") for _ in range(2))
    # python -c "from nnss_cli.datasets.catalog import load; print(load('twotank-sim').fingerprint())"
    assert first.fingerprint() == second.fingerprint() == "5f4cc6f70c3468ea"  # kept runs are of these samples
    assert lengths(first) == {"train": [1500], "val": [500], "test": [1500]}
    assert lengths(simulated.load(None, "strict")) == {"train": [1500], "val": [500], "test": [1000]}
    assert first.tests["test"][0].y.min() > -0.05
    # at rest, flow in = flow out: h2 = (k u / a2)² / 2g
    levels = simulated.simulate_two_tank(np.full(1500, 5.0), np.array([0.1, 0.1]))
    np.testing.assert_allclose(levels[-1, 1], (0.005 * 5 / 0.015) ** 2 / (2 * 9.81), rtol=1e-3)


def test_the_ode_reproduces_the_recorded_plant(mirror: Path) -> None:
    dataset = twotank.load(mirror / "TwoTanksMatlab.mat", "strict")
    record = dataset.tests["test"][0]
    best = min(
        np.sqrt(
            np.mean(
                (
                    simulated.simulate_two_tank(record.u[:, 0], np.array([h, float(record.y[0, 0])]))[:, 1]
                    - record.y[:, 0]
                )
                ** 2
            )
        )
        for h in np.linspace(0.0, 0.6, 13)
    )
    assert best < 0.006  # the noise floor is 0.005
