"""The report folder: tables, figures, summary, clouds and effective settings."""

from __future__ import annotations

import base64
import dataclasses
import html
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import yaml
from tqdm import tqdm

from evals.validation import paper
from evals.validation.experiment import Validation, pair_name
from evals.validation.figures import all_figures
from evals.validation.odometry import effective_odometry
from evals.validation.tables import Table, make_tables
from evals.validation.verdict import Criterion, criteria, findings, headline
from utils.atomic import atomic_path
from utils.clouds.cloud import PointCloud
from utils.clouds.io import write_cloud
from utils.export_products import run_environment, save_json

_CSS = """
body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:1200px;padding:0 1em;color:#222}
h1{font-size:1.6em}h2{font-size:1.15em;margin:1.8em 0 .5em}table{border-collapse:collapse;font-size:.86em}
th{text-align:left;background:#f3f3f3}td,th{border:1px solid #ddd;padding:.3em .6em;vertical-align:top}
tr.paper td{color:#666;font-style:italic}.note,figcaption{color:#666;font-size:.86em}.scroll{overflow-x:auto}
figure{margin:1.6em 0}img{max-width:100%}.met{color:#0a7d34}.missed{color:#b3261e}.lead{font-size:1.1em}
"""


def write_report(found: Validation) -> list[Path]:
    """Write everything about a validation into its report folder.

    `validation.html` (self-contained), `validation.md`, `validation.json`, `tables/*.csv`, `figures/*.png`,
    `clouds/*.ply` (metres, frame of the ground truth), `config.yaml` (effective settings).

    Returns:
        The files, the summary first.

    Raises:
        OutputError: a file cannot be written.
    """
    out = found.settings.out
    written = [_write_figure(out / "figures" / f"{name}.png", draw(found))
               for name, (_, draw) in tqdm(all_figures().items(), desc="figures", unit="figure")]
    for name, points in found.points.items():
        target = out / "clouds" / f"{_file_name(name)}.ply"
        write_cloud(target, PointCloud(points, metadata={"frame": "world of the ground truth", "unit": "metre"}))
        written.append(target)
    judged = criteria(found, duration_s(found))
    tables = make_tables(found, judged)
    said = findings(found)
    for table in tables:
        written.append(_write_text(out / "tables" / f"{table.name}.csv", table.csv()))
    settings = effective_settings(found)
    written.append(_write_text(out / "config.yaml", yaml.safe_dump(settings, sort_keys=False)))
    written.append(save_json(out / "validation.json", _figures_as_json(found, judged, said, settings)))
    written.append(_write_text(out / "validation.md", markdown(found, tables, judged, said)))
    summary = _write_text(out / "validation.html", page(found, tables, judged, said))
    return [summary, *reversed(written)]


def duration_s(found: Validation) -> float:
    """Seconds of the whole run, without writing the report."""
    return sum(found.seconds.values())


def effective_settings(found: Validation) -> dict[str, Any]:
    """Every setting that had an effect, as plain values."""
    setup = found.setup
    return {
        "validation": found.settings.as_dict(), "odometry": effective_odometry(found.settings),
        "emvs": {**dataclasses.asdict(setup.emvs), "start_us": setup.start_us, "stop_us": setup.stop_us,
                 "reference_us": setup.reference_us, "min_depth_m": setup.near_m, "max_depth_m": setup.far_m,
                 "every_nth_event": setup.event_stride, "radius_search": "0.05 m, scaled with the poses"},
        "recording": _plain(found.source.sequence.describe()), "environment": _plain(run_environment()),
    }


def markdown(found: Validation, tables: list[Table], judged: list[Criterion], said: list[str]) -> str:
    """The report as Markdown."""
    lines = [f"# Validation of the exported cloud: {found.source.sequence.name}", "", headline(judged), ""]
    lines += [f"* {sentence}" for sentence in [*said, *found.notes]]
    lines += ["", *(table.markdown() for table in tables), "## Figures", ""]
    lines += [f"![{caption}](figures/{name}.png)\n\n{caption}\n" for name, (caption, _) in all_figures().items()]
    return "\n".join(lines)


def page(found: Validation, tables: list[Table], judged: list[Criterion], said: list[str]) -> str:
    """The report as one HTML page with its pictures inside."""
    title = html.escape(f"Validation of the exported cloud: {found.source.sequence.name}")
    parts = [f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{title}</title>"
             f"<style>{_CSS}</style></head><body><h1>{title}</h1>",
             f"<p class='lead {'met' if all(one.passed is not False for one in judged) else 'missed'}'>"
             f"{html.escape(headline(judged))}</p>", tables[0].html(), "<h2>Findings</h2><ul>",
             *(f"<li>{html.escape(sentence)}</li>" for sentence in [*said, *found.notes]), "</ul>"]
    for name, (caption, _) in all_figures().items():
        data = base64.b64encode((found.settings.out / "figures" / f"{name}.png").read_bytes()).decode("ascii")
        parts.append(f"<figure><img alt='{html.escape(caption, quote=True)}' src='data:image/png;base64,{data}'>"
                     f"<figcaption>{html.escape(caption)}</figcaption></figure>")
    parts += [table.html() for table in tables[1:]]
    parts.append(f"<p class='note'>Reference rows: {html.escape(paper.SOURCE)}; its lengths are units of the odometry, "
                 f"{paper.UNITS_PER_M} to the metre.</p></body></html>\n")
    return "".join(parts)


def _figures_as_json(found: Validation, judged: list[Criterion], said: list[str],
                     settings: dict[str, Any]) -> dict[str, Any]:
    units = found.alignment.units_per_m
    return _plain({
        "sequence": found.source.sequence.name, "headline": headline(judged),
        "criteria": [{**dataclasses.asdict(one), "outcome": one.word} for one in judged], "findings": said,
        "notes": found.notes, "units_per_m": units, "distance_m": found.distance_m, "seeds": found.settings.seeds,
        "trajectory": {"ate_rmse_m": found.alignment.ate_rmse_m, "poses": found.alignment.poses,
                       "rotation_residual_deg": found.alignment.rotation_residual_deg,
                       "path_length_m": found.alignment.path_length_m,
                       "metric_T_devo": found.alignment.metric_T_devo.matrix()},
        "trials": [dataclasses.asdict(trial) for trial in found.trials],
        "cleaning": [str(report) for report in found.cleaning],
        "maps": {key: {"label": result.variant.label, "points": len(result.points), "poses": result.poses_in_span,
                       "units_per_m": result.variant.units_per_m, **result.view.describe()}
                 for key, result in found.maps.items()},
        "agreement": {agreement.name: {stage: {
            "chamfer_m": dataclasses.asdict(agreement.chamfer[stage]),
            "chamfer_units": {key: value * units for key, value in
                              dataclasses.asdict(agreement.chamfer[stage]).items()},
            "scores": [{**dataclasses.asdict(score), "threshold_units": score.threshold * units}
                       for score in agreement.scores[stage]]} for stage in agreement.chamfer}
                      for agreement in found.agreements},
        "reading": {"precision": "share of the first cloud near the second, as in the paper",
                    "recall": "share of the second cloud near the first", "names": pair_name("first", "second")},
        "icp": {agreement.name: None if agreement.icp is None else {
            "fitness": agreement.icp.fitness, "inlier_rmse_m": agreement.icp.inlier_rmse,
            "rotation_deg": agreement.icp.rotation_deg, "translation_m": agreement.icp.translation_norm}
                for agreement in found.agreements},
        "planarity": {name: {"rmse_m": flat.least_squares.rmse, "rmse_units": flat.least_squares.rmse * units,
                             "median_m": flat.least_squares.median_distance,
                             "inlier_share": flat.robust.inlier_share, "inlier_rmse_m": flat.robust.inlier_rmse}
                      for name, flat in found.planarities.items()},
        "depth": {name: dataclasses.asdict(error) for name, error in found.depth.items()},
        "image": {name: dataclasses.asdict(edge) for name, edge in found.edges.items()},
        "seconds": found.seconds, "settings": settings})


def _plain(value: Any) -> Any:
    """Values that JSON and YAML know; NaN becomes None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, Path):
        return str(value)
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _write_figure(path: Path, figure: Any) -> Path:
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        save_figure(figure, file)
    return path


def save_figure(figure: Any, file: BinaryIO) -> None:
    """Write a figure as PNG; the same figure gives the same bytes."""
    figure.savefig(file, format="png", dpi=130, metadata={"Software": None})


def _write_text(path: Path, text: str) -> Path:
    with atomic_path(path) as temporary:
        temporary.write_text(text, "utf-8")
    return path


def _file_name(name: str) -> str:
    return name.lower().replace(", ", "_").replace(" ", "_")
