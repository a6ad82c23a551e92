"""sdist and wheel: built from what git would commit, installed, and used as a new user would, in an
empty folder."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from hashlib import sha256
from pathlib import Path

import pytest
from copies import ROOT

pytestmark = pytest.mark.slow
NOT_FOR_USERS = ("/reference/", "/tests/", ".png", "ppo.")


def called(*command: str | Path, where: Path, **variables: str) -> str:
    """What a command prints, which has to end well; it sees this environment but for its Python's
    settings."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "COV_", "VIRTUAL"))
    }
    done = subprocess.run(
        [*map(str, command)],
        cwd=where,
        env=kept | variables,
        capture_output=True,
        text=True,
        encoding="utf-8",
    )
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"
    return done.stdout


def contents(wheel: Path) -> dict[str, str]:
    """Name -> hash, of all files but the record of them."""
    with zipfile.ZipFile(wheel) as packed:
        return {
            name: sha256(packed.read(name)).hexdigest()
            for name in packed.namelist()
            if "RECORD" not in name
        }


def hashes(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): sha256(path.read_bytes()).hexdigest()
        if path.is_file()
        else ""
        for path in folder.rglob("*")
        if "__pycache__" not in path.parts
    }


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> tuple[Path, Path, Path]:
    """The sdist, the wheel made of it, and one made of the tree."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("dist")
    names = called(
        "git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", where=ROOT
    ).split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    build = (sys.executable, "-m", "build", "--no-isolation")
    called(*build, "--outdir", out / "both", source, where=out)
    called(*build, "--wheel", "--outdir", out / "tree", source, where=out)
    return (
        next((out / "both").glob("*.tar.gz")),
        next((out / "both").glob("*.whl")),
        next((out / "tree").glob("*.whl")),
    )


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Path:
    """A virtual environment with the wheel and, to have them no second time, the libraries of this
    one."""
    folder = tmp_path_factory.mktemp("a new user")
    called(sys.executable, "-m", "venv", "--without-pip", folder / "venv", where=folder)
    programs = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
    pip = (sys.executable, "-m", "pip", "--python", programs / "python")
    called(*pip, "install", "--no-deps", "--no-index", built[1], where=folder)
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site = Path(called(programs / "python", "-c", code, where=folder).strip())
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return programs


def test_the_sdist_makes_the_same_wheel(built):
    sdist, wheel, of_tree = built
    assert contents(wheel) == contents(of_tree)
    with tarfile.open(sdist) as packed:
        scenarios = [name for name in packed.getnames() if name.endswith("/scenario.toml")]
    assert len(scenarios) == len([*ROOT.glob("scenarios/*/scenario.toml")])


def test_what_is_in_the_wheel(built):
    names = contents(built[1])
    assert not [name for name in names if any(word in f"/{name}" for word in NOT_FOR_USERS)]
    assert {"nmfd/CITATION.cff", "nmfd/py.typed", "cosim/reporting/report.html.j2"} <= set(names)
    for kind in ("scenario", "network"):
        for file in ROOT.glob(f"{kind}s/*/{kind}.toml"):
            assert f"nmfd/data/{file.relative_to(ROOT).as_posix()}" in names
    assert built[1].stat().st_size < 30e6


def test_a_new_user(installed):
    """In an empty folder with a space in its name, and nothing of the package is written to."""
    where = installed.parent.parent / "my folder"
    where.mkdir()

    def run(program: str, *words: str) -> str:
        return called(installed / program, *words, where=where)

    data = Path(run("python", "-c", "from nmfd.runs import shipped; print(shipped.root())").strip())
    assert data.is_relative_to(installed.parent)
    assert data.name == "data"
    before = hashes(data)
    assert "grid7_peak" in run("nmfd", "show")
    assert "no-control" in run(
        "nmfd", "benchmark", "economic_mpc", "--controllers", "no-control", "--seeds", "1"
    )
    assert "pi-gating" in run(
        "cosim", "run", "grid7_peak", "--controller", "pi-gating", "--steps", "3", "--out", "out"
    )
    run("cosim", "run", "grid7_peak", "--controller", "webster", "--steps", "1", "--out", "webster")
    assert "Written to" in run("cosim", "report", "out")
    run("python", "-c", EVERYTHING)
    assert hashes(data) == before
    assert sorted(path.name for path in where.iterdir()) == ["out", "runs", "webster"]


# Every scenario that comes along can be loaded, every city simulated, every policy read.
EVERYTHING = """
from cosim.plant.settings import settings
from cosim.sumo.net import city_files
from nmfd.api import controller, load_scenario
from nmfd.runs import config, shipped

for folder in shipped.folders(shipped.SCENARIO):
    scenario = load_scenario(folder.name)
    assert shipped.installed(scenario.folder) and shipped.installed(scenario.network.folder)
    if "sumo" in config.read(scenario.network.folder / "network.toml"):
        settings(scenario), city_files(scenario.network)
    for file in folder.glob("dpc-*.pt"):
        assert controller(file.stem, scenario)
"""
