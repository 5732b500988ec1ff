"""The rules of the house that can be read from the source: import direction, what `devo/` may not do, file sizes."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ORDER = {"devo": 0, "utils": 1, "evals": 2, "scripts": 3}
NOT_IN_DEVO = {"evo", "open3d", "matplotlib", "h5py", "cv2", "tqdm"}
HEAVY = {"open3d", "matplotlib", "evo"}
MAX_LINES = 450
SOURCES = sorted(path for top in ORDER for path in (ROOT / top).rglob("*.py"))


def imports(tree: ast.AST) -> list[tuple[int, str]]:
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.append((node.lineno, node.module))
    return found


@pytest.fixture(scope="module")
def trees() -> dict[Path, ast.Module]:
    assert len(SOURCES) > 30
    return {path: ast.parse(path.read_text(encoding="utf-8")) for path in SOURCES}


def test_imports_go_one_way(trees: dict[Path, ast.Module]) -> None:
    wrong = []
    for path, tree in trees.items():
        top = path.relative_to(ROOT).parts[0]
        for line, module in imports(tree):
            other = module.split(".")[0]
            # the command line helper of scripts/ is shared by all scripts, nothing below may use it
            if other in ORDER and ORDER[other] > ORDER[top]:
                wrong.append(f"{path.relative_to(ROOT)}:{line} imports {module}")
    assert not wrong, "\n".join(wrong)


def test_devo_stays_free_of_plots_files_and_prints(trees: dict[Path, ast.Module]) -> None:
    wrong = []
    for path, tree in trees.items():
        if path.relative_to(ROOT).parts[0] != "devo":
            continue
        wrong += [f"{path.name}:{line} imports {name}" for line, name in imports(tree)
                  if name.split(".")[0] in NOT_IN_DEVO]
        wrong += [f"{path.name}:{node.lineno} prints" for node in ast.walk(tree)
                  if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print" and path.name != "info.py"]
    assert not wrong, "\n".join(wrong)


def test_heavy_packages_are_imported_where_they_are_used(trees: dict[Path, ast.Module]) -> None:
    wrong = []
    for path, tree in trees.items():
        top_level = [node for node in tree.body if isinstance(node, (ast.Import, ast.ImportFrom))]
        wrong += [f"{path.relative_to(ROOT)}:{line} imports {name}" for node in top_level
                  for line, name in imports(node) if name.split(".")[0] in HEAVY]
    assert not wrong, "\n".join(wrong)


def test_no_bare_except_and_no_stub(trees: dict[Path, ast.Module]) -> None:
    wrong = []
    for path, tree in trees.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ExceptHandler) and node.type is None:
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} bare except")
            if isinstance(node, ast.Raise) and "NotImplementedError" in ast.dump(node):
                wrong.append(f"{path.relative_to(ROOT)}:{node.lineno} NotImplementedError")
    assert not wrong, "\n".join(wrong)


def test_files_fit_a_reader(trees: dict[Path, ast.Module]) -> None:
    long = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8").count("\n") for path in trees}
    assert not {name: lines for name, lines in long.items() if lines > MAX_LINES}


def test_importing_is_quiet_and_light() -> None:
    """Importing the core loads no plotting, evaluation or file package, starts no CUDA context and prints nothing."""
    code = (
        "import sys, torch, devo.devo, devo.enet, devo.net, devo.checkpoint, devo.ba\n"
        f"heavy = sorted({NOT_IN_DEVO - {'tqdm'}!r} & {{name.split('.')[0] for name in sys.modules}})\n"
        "assert not heavy, heavy\n"
        "assert not torch.cuda.is_initialized()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "" and done.stderr == ""
