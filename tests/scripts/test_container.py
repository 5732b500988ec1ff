"""The container as far as it can be checked without an engine: build context, stages, entry point."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8")
INSTRUCTIONS = re.findall(r"^([A-Z]+) (.+)$", DOCKERFILE, flags=re.M)


def context() -> list[str]:
    """What `.dockerignore` lets into the image, from the top of the checkout."""
    lines = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert lines[0] == "**"
    return [line.removeprefix("!") for line in lines if line.startswith("!")]


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with exactly the files of the image."""
    folder = tmp_path_factory.mktemp("image") / "devo"
    folder.mkdir()
    for name in context():
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


def run(image: Path, *words: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    return subprocess.run([str(image / "scripts" / "container.sh"), *words], capture_output=True, text=True,
                          timeout=300, cwd=cwd or "/", env={"PATH": path, "PYTHONPATH": str(image), "HOME": "/tmp"})


def test_stages_and_user() -> None:
    stages = re.findall(r"^FROM \S+ AS (\S+)$", DOCKERFILE, flags=re.M)
    assert stages[-1] == "cpu" and {"cpu", "cuda"} <= set(stages)  # the last stage is the default target
    for base in re.findall(r"^FROM (\S+) AS", DOCKERFILE, flags=re.M):
        assert base in stages or base == "${PYTHON_IMAGE}"
    assert set(re.findall(r"--from=(\S+)", DOCKERFILE)) <= set(stages)
    names = [name for name, _ in INSTRUCTIONS]
    assert "EXPOSE" not in names and "sudo" not in DOCKERFILE
    assert [value for name, value in INSTRUCTIONS if name == "USER"] == ["devo"]
    assert names.index("USER") < names.index("ENTRYPOINT") and "HEALTHCHECK" in names and "LABEL" in names
    assert "${PYTHON_IMAGE}" in DOCKERFILE and "latest" not in DOCKERFILE


def test_the_image_holds_what_it_needs_and_no_more(image: Path) -> None:
    assert not (image / "tests").exists() and not (image / ".git").exists() and not (image / ".venv").exists()
    assert (image / "devo" / "weights" / "devo-tiny.pth").is_file()
    readme = re.search(r'^readme = "(.+)"', (image / "pyproject.toml").read_text(), flags=re.M)
    assert readme is not None and (image / readme[1]).is_file()
    entry = re.search(r'^ENTRYPOINT \["/opt/devo/(.+)"\]', DOCKERFILE, flags=re.M)
    assert entry is not None and os.access(image / entry[1], os.X_OK)


def test_entry_point(image: Path, tmp_path: Path) -> None:
    assert "pipeline" in run(image).stdout and "pp_fpv" in run(image, "help").stdout
    done = run(image, "pipeline", "--help", cwd=tmp_path)
    assert done.returncode == 0 and done.stdout.startswith("usage: start_pipline.py")
    assert run(image, "export", "--no_such_flag").returncode == 2
    unknown = run(image, "nosuch")
    assert unknown.returncode == 2 and len(unknown.stderr.strip().splitlines()) == 1 and "selftest" in unknown.stderr
    where = run(image, "python", "-c", "import devo.config, utils.cli; print(devo.config.__file__, utils.cli.__file__)")
    assert all(file.startswith(str(image)) for file in where.stdout.split()) and where.stdout, where.stderr


@pytest.mark.slow
def test_selftest(image: Path, tmp_path: Path) -> None:
    """Simulate, track, map and compare from the files of the image; the environment is the one that runs the tests."""
    venv = Path(sys.executable).parents[1]
    path = f"{venv / 'bin'}:{os.environ['PATH']}"
    done = subprocess.run([str(image / "scripts" / "container.sh"), "selftest"], capture_output=True, text=True,
                          timeout=1800, cwd="/", env={"PATH": path, "PYTHONPATH": str(image), "HOME": str(tmp_path),
                                                      "VENV": str(venv), "DEMO_DIR": str(tmp_path)})
    assert done.returncode == 0, done.stderr[-2000:]
    assert "path: ATE" in done.stdout and "emvs.ply" in done.stdout
