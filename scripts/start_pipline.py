#!/usr/bin/env python3
"""From a recording to trajectory, cleaned cloud, picture and a page to look at, in one command.

Example: python scripts/start_pipline.py my_recording
         python scripts/start_pipline.py datasets/board_slow --run-emvs -- --stride 2 --start_us 5e6

Stages: preprocess (if the data set needs it), export (track), ply, cleanup, emvs (on request), view. The folder of
results holds pipeline.json with what each stage did; --resume leaves alone what is unchanged. Everything after -- goes
to export_pointcloud.py. Exit code 0: all went well; 1: a stage failed; 2: wrong arguments or paths.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from scripts.edge_options import add_edge_options  # noqa: E402
from scripts.export_pointcloud import build_arg_parser as build_export_parser  # noqa: E402
from utils.cli import AliasParser, run_cli  # noqa: E402 - needs the path above

if TYPE_CHECKING:
    from utils.pipeline import PipelineOptions

EDGE_OPTIONS = ("topk", "border", "knn", "max_dist")
OWN_EXPORT_FLAGS = {"--datapath": "the folder", "--dataset": "--dataset", "--side": "--side",
                    "--out": "--outdir and --outname", "--frame-data-out": "--frame_out",
                    "--weights": "--weights", "--config": "--config", "--device": "--device", "--seed": "--seed",
                    "--cleanup": "--cleanup-algorithm", "--no-cleanup": "nothing: the raw cloud is kept anyway"}
"""Flags of the export that the pipeline decides, and what to use instead of them after `--`."""


def build_arg_parser() -> argparse.ArgumentParser:
    """The command line; every flag also works with hyphens for underscores and the other way round."""
    parser = AliasParser(prog="start_pipline.py", description=__doc__)
    add = parser.add_argument
    add("folder", nargs="?", metavar="FOLDER", help="recording: its folder or one around it, a ROS bag, an event file")
    add("--indir", metavar="FOLDER", help="the same as the positional argument")
    add("--outdir", help="folder of results (default: results/NAME in the working directory)")
    add("--dataset", "--export-dataset", dest="dataset", default="auto",
        help="how to read it: generic, fpv, rpg, vector, ...; auto looks at its files")
    add("--side", "--export-side", dest="side", choices=("left", "right"), default="left",
        help="camera of a stereo recording")
    add("--weights", help="checkpoint, name of built-in weights, or random:SEED (default: the built-in ones)")
    add("--config", help="settings as YAML (default: preset of the weights or of the data set)")
    add("--device", default="auto", help="auto, cpu, cuda or cuda:0")
    add("--seed", type=int, default=0, help="seed of patch selection and initial depths")
    add("--outname", default="pointcloud.npy", help="file name of the cloud")
    add("--frame_out", default="frames.npz", help="file name of the structure per frame")
    run = parser.add_argument_group("how it runs")
    run.add_argument("--resume", action="store_true",
                     help="leave stages alone whose input, settings and products are unchanged")
    run.add_argument("--dry-run", action="store_true", help="say what would be done, and do nothing")
    run.add_argument("--keep-going", action="store_true", help="after a failed stage, run those that still can")
    run.add_argument("--overwrite-preprocessing", action="store_true",
                     help="preprocess anew what was preprocessed before")
    run.add_argument("--view", action=argparse.BooleanOptionalAction, default=True,
                     help="write the page that shows the cloud in a browser")
    run.add_argument("--display", action="store_true", help="open that page at the end (needs a display)")
    run.add_argument("--verbose", "-v", action="store_true", help="also print what each filter removed")
    _add_edges(parser)
    _add_cleanup(parser)
    _add_emvs(parser)
    return parser


def _add_edges(parser: AliasParser) -> None:
    edges = parser.add_argument_group("edge cloud")
    edges.add_argument("--export_edge_cloud", action="store_true", help="also write points along image edges")
    add_edge_options(edges, EDGE_OPTIONS)


def _add_cleanup(parser: AliasParser) -> None:
    clean = parser.add_argument_group("cleanup, after the quality filter")
    clean.add_argument("--cleanup-algorithm", choices=("ror", "sor"), default="ror", help="radius or statistical")
    clean.add_argument("--cleanup-output", metavar="FILE", help="cleaned cloud (default: NAME_cleaned.ply)")
    clean.add_argument("--nb_neighbors", type=int, default=20, help="sor: neighbours looked at")
    clean.add_argument("--std_ratio", type=float, default=2.0, help="sor: how many standard deviations may be kept")
    clean.add_argument("--radius", type=float, help="ror: radius (default: 3 x median neighbour distance)")
    clean.add_argument("--min_neighbors", type=int,
                       help="ror: other points needed within it (default: 4, with a given radius 16)")


def _add_emvs(parser: AliasParser) -> None:
    emvs = parser.add_argument_group("semi-dense map (EMVS)")
    emvs.add_argument("--run-emvs", action="store_true", help="map along the trajectory, into emvs/")
    emvs.add_argument("--emvs-backend", choices=("python", "ros"), default="python",
                      help="the built-in mapper, or rosrun mapper_emvs run_emvs")
    emvs.add_argument("--emvs-min-depth", type=float, help="nearest depth (default: from the cloud)")
    emvs.add_argument("--emvs-max-depth", type=float, help="farthest depth (default: from the cloud)")
    emvs.add_argument("--emvs-dimZ", type=int, default=100, help="depth planes")
    bag = parser.add_argument_group("hand-over to EMVS in ROS")
    bag.add_argument("--export-emvs-mono", action="store_true", help="write bag and flag file (needs no ROS)")
    bag.add_argument("--emvs-bag-name", default="emvs_input.bag", help="name of the bag")
    bag.add_argument("--emvs-conf-name", default="emvs_mono.conf", help="name of the flag file")
    bag.add_argument("--emvs-side", choices=("left", "right"), help="camera (default: the tracked one)")
    bag.add_argument("--emvs-event-topic", default="/dvs/events", help="topic of the events")
    bag.add_argument("--emvs-camera-info-topic", default="/dvs/camera_info", help="topic of the camera")
    bag.add_argument("--emvs-pose-topic", default="/pose", help="topic of the poses, camera to world")
    bag.add_argument("--emvs-t-margin-s", type=float, default=0.5, help="events around the time of the poses [s]")
    bag.add_argument("--emvs-overwrite", action="store_true", help="replace a bag that no earlier run has written")


def split_words(argv: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words of the pipeline, and those after `--` that are meant for the export."""
    words = list(argv)
    end = words.index("--") if "--" in words else len(words)
    return words[:end], words[end + 1:]


def export_arguments(args: argparse.Namespace, forwarded: Sequence[str], parser: argparse.ArgumentParser) -> dict[
        str, Any]:
    """The arguments of the export by name: those of the pipeline, and the forwarded ones."""
    for word in forwarded:
        flag = "--" + word.partition("=")[0][2:].replace("_", "-") if word.startswith("--") else ""
        if flag in OWN_EXPORT_FLAGS:
            parser.error(f"{word} after -- is decided by the pipeline; use {OWN_EXPORT_FLAGS[flag]}")
    words = ["--datapath", args.folder, "--device", args.device, "--seed", str(args.seed), "--side", args.side]
    for name in ("weights", "config"):
        if getattr(args, name):
            words += [f"--{name}", getattr(args, name)]
    if args.export_edge_cloud:
        words.append("--export_edge_cloud")
        for name in EDGE_OPTIONS:
            words += [f"--edge_{name}", str(getattr(args, f"edge_{name}"))]
    return vars(build_export_parser().parse_args([*words, *forwarded]))


def parse(argv: Sequence[str]) -> tuple[argparse.Namespace, dict[str, Any]]:
    """Arguments of the pipeline and of the export; a wrong command line ends the program with exit code 2."""
    words, forwarded = split_words(argv)
    parser = build_arg_parser()
    args = parser.parse_args(words)
    given = {str(Path(folder)) for folder in (args.folder, args.indir) if folder}
    if len(given) != 1:
        parser.error("expected a folder, as positional argument or as --indir" if not given
                     else f"two folders were given, {args.folder} and {args.indir}; expected one")
    args.folder = args.folder or args.indir
    for name in ("outname", "frame_out", "emvs_bag_name", "emvs_conf_name"):
        file = getattr(args, name)
        if Path(file).name != file:
            parser.error(f"--{name.replace('_', '-')} is a file name in the folder of results, found {file!r}; the "
                         "folder is chosen with --outdir")
    if args.display and not args.view:
        parser.error("--display shows the page that --no-view leaves out; give only one of them")
    return args, export_arguments(args, forwarded, parser)


def pipeline_options(args: argparse.Namespace, export: dict[str, Any], command: Sequence[str]) -> PipelineOptions:
    """The parsed arguments in the form that the pipeline takes."""
    from utils.pipeline.options import CleanupOptions, EmvsStageOptions, PipelineOptions

    return PipelineOptions(
        indir=args.folder, export=export, outdir=args.outdir, dataset=args.dataset, side=args.side,
        outname=args.outname, frame_out=args.frame_out,
        cleanup=CleanupOptions(args.cleanup_algorithm, args.cleanup_output, args.nb_neighbors, args.std_ratio,
                               args.radius, args.min_neighbors),
        emvs=EmvsStageOptions(
            run=args.run_emvs, backend=args.emvs_backend, export_bag=args.export_emvs_mono, side=args.emvs_side,
            bag_name=args.emvs_bag_name, conf_name=args.emvs_conf_name, event_topic=args.emvs_event_topic,
            camera_info_topic=args.emvs_camera_info_topic, pose_topic=args.emvs_pose_topic,
            min_depth=args.emvs_min_depth, max_depth=args.emvs_max_depth, dimZ=args.emvs_dimZ,
            t_margin_s=args.emvs_t_margin_s, overwrite=args.emvs_overwrite), view=args.view,
        overwrite_preprocessing=args.overwrite_preprocessing, resume=args.resume, dry_run=args.dry_run,
        keep_going=args.keep_going, command=tuple(command))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    words = sys.argv[1:] if argv is None else list(argv)
    args, export = parse(words)
    from devo.errors import InputError
    from utils.pipeline import run_pipeline
    from utils.viewer.window import has_display

    if args.display and not has_display():
        raise InputError("--display: there is no display here; leave it out and open the page elsewhere")
    result = run_pipeline(pipeline_options(args, export, words))
    if args.verbose:
        print("\n".join(result.details()))
    print("\n".join(result.lines))
    if args.display and result.page.is_file() and not args.dry_run:
        import webbrowser

        webbrowser.open(result.page.resolve().as_uri())
    return 0 if result.record.status == "ok" else 1


if __name__ == "__main__":
    sys.exit(run_cli(main))
