"""Training log: one CSV row per entry and a picture of the curves."""

from __future__ import annotations

import csv
import math
from pathlib import Path

from utils.atomic import atomic_path

PANELS = (
    ("total", "direct", "direct_first", "probe", "match"),
    ("flow", "flow_last"),
    ("pose",),
    ("scores",),
    ("val_flow", "val_first", "val_probe", "val_last"),
    ("val_ate", "val_lost"),
)


class TrainingLog:
    """Appends rows of numbers to `<folder>/<name>.csv`; the columns are those of the first row."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.columns: list[str] | None = None
        if path.is_file():
            with path.open(newline="") as stream:
                self.columns = next(csv.reader(stream), None)

    def append(self, row: dict[str, float]) -> None:
        """Write one row; missing columns stay empty, a new column is an error of the caller."""
        first = self.columns is None
        if self.columns is None:
            self.columns = list(row)
            self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, self.columns, restval="", extrasaction="raise")
            if first:
                writer.writeheader()
            writer.writerow(
                {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
            )


def read_log(path: Path) -> dict[str, list[float]]:
    """Columns of a log; empty cells are NaN."""
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    names = list(rows[0]) if rows else []
    return {name: [float(row[name]) if row[name] else math.nan for row in rows] for name in names}


def draw_curves(training: Path, validation: Path, picture: Path) -> None:
    """Draw the columns of both logs over the step, logarithmic, into a PNG."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.figure import Figure

    columns = read_log(training) if training.is_file() else {}
    checks = read_log(validation) if validation.is_file() else {}
    curves = {name: (columns["step"], values) for name, values in columns.items() if name != "step"}
    curves |= {f"val_{name}": (checks["step"], values) for name, values in checks.items() if name != "step"}
    figure = Figure(figsize=(15, 8))
    for number, names in enumerate(PANELS):
        axes = figure.add_subplot(2, 3, number + 1)
        for name in names:
            if name in curves and any(value > 0 for value in curves[name][1]):
                axes.plot(*curves[name], label=name, linewidth=1)
        axes.set_yscale("log")
        axes.set_xlabel("step")
        axes.grid(alpha=0.3, which="both")
        if axes.lines:
            axes.legend(fontsize=8)
    figure.tight_layout()
    with atomic_path(picture) as temporary:
        figure.savefig(temporary, dpi=80)
