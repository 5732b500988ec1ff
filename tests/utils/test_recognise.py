"""Recognising data sets: minimal marker files of each, nested folders, archives, and what is said about the rest."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from devo.errors import InputError
from tests.utils.bag_samples import write_bag
from tests.utils.event_samples import random_events
from utils.datasets.recognise import LAYOUTS, AmbiguousError, Recognised, recognise
from utils.datasets.registry import open_sequence

FILES = {
    # data set: (ready, what preprocessing makes of it, raw), relative to the folder that holds the sequence `seq`
    "fpv": (["seq/events.txt", "seq/t_offset_us.txt", "seq/images_timestamps_us.txt", "seq/calib_undist.txt",
             "seq/rectify_map.h5"], ["seq/events.txt", "seq/images.txt", "seq/img/image_0_0.png"]),
    "ecd": (["seq/events.txt", "seq/tss_us.txt", "seq/calib_undist.txt", "seq/rectify_map.h5"],
            ["seq/events.txt", "seq/images.txt", "seq/images/frame_00000000.png", "seq/calib.txt"]),
    "rpg": (["seq/evs_left.txt", "seq/tss_imgs_us_left.txt", "seq/calib_undist_left.txt", "seq/rectify_map_left.h5"],
            ["seq.bag"]),
    "hku": (["seq/evs_left.h5", "seq/tss_imgs_us_left.txt", "seq/calib_undist_left.txt", "seq/rectify_map_left.h5"],
            ["seq.bag"]),
    "vector": (["seq/seq1.synced.left_event.hdf5", "seq/tss_imgs_us_left.txt", "seq/calib_undist_evs_left.txt",
                "seq/rectify_map_left.h5"],
               ["seq/seq1.synced.left_event.hdf5", "seq/seq1.synced.left_camera/timestamp.txt", "0_calib/left.yaml"]),
    "tumvie": (["seq/seq-events_left.h5", "seq/calib_undist.json", "seq/rectify_map_left.h5",
                "seq/left_images_undistorted/image_timestamps_left.txt"],
               ["seq/seq-events_left.h5", "seq/left_images/image_timestamps_left.txt", "seq/mocap_data.txt",
                "camera-calibrationB.json"]),
    "eds": (["seq/events.h5", "seq/t_offset_us.txt", "seq/images_timestamps_us.txt", "seq/rectify_map_calib0.h5"],
            ["seq/events.h5", "seq/images_timestamps.txt", "seq/images/frame_0.png"]),
    "mvsec": (["seq_data/seq_data.hdf5", "seq_data/tss_imgs_us_left.txt", "seq_data/calib_undist_left.txt",
               "seq_data/rectify_map_left.h5"],
              ["seq_data.hdf5", "indoor_flying_calib/camchain-imucam-indoor_flying.yaml"]),
    "tartan": (["seq/h5/0000000001.h5"], []),
    "generic": (["seq/events.h5", "seq/calib.yaml"], []),
}
TOPICS = {"rpg": "/optitrack/davis_stereo", "hku": "/cpy_uav/viconros/odometry"}
RAW = sorted(name for name, (_, raw) in FILES.items() if raw)


def make(root: Path, dataset: str, ready: bool) -> Path:
    """Write the files of one sequence; returns its folder (of a raw archive: the archive)."""
    for name in FILES[dataset][0 if ready else 1]:
        file = root / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if file.suffix == ".bag":
            write_bag(file, {"/davis_left/events": [random_events(5)]}, other_topics=[TOPICS[dataset]])
        else:
            file.touch()
    if not ready and dataset in TOPICS:
        return root / "seq.bag"
    if not ready and dataset == "mvsec":
        return root / "seq_data.hdf5"
    return root / ("seq_data" if dataset == "mvsec" else "seq")


def test_every_layout_is_tested() -> None:
    assert {layout.dataset for layout in LAYOUTS} | {"generic"} == set(FILES)


@pytest.mark.parametrize("dataset", sorted(FILES))
def test_prepared_sequences_are_recognised(dataset: str, tmp_path: Path) -> None:
    folder = make(tmp_path, dataset, ready=True)
    found = recognise(folder)
    assert (found.dataset, found.path, found.ready) == (dataset, folder, True)
    assert f"is {dataset} by its" in str(found) and found.found[0] in str(found)
    assert recognise(folder, dataset=dataset) == found and found.require_ready() is found


@pytest.mark.parametrize("dataset", RAW)
def test_raw_sequences_name_the_command_that_prepares_them(dataset: str, tmp_path: Path) -> None:
    source = make(tmp_path, dataset, ready=False)
    found = recognise(source)
    assert (found.dataset, found.ready, found.source) == (dataset, False, source)
    assert found.path == (tmp_path / ("seq_data" if dataset == "mvsec" else "seq"))
    with pytest.raises(InputError, match=rf"not preprocessed: .*rectify_map.* missing; make it with: python scripts/"
                                         rf"pp_{dataset}.py --indir {source}"):
        found.require_ready()


@pytest.mark.parametrize("dataset", RAW)
def test_prepared_files_go_before_raw_ones(dataset: str, tmp_path: Path) -> None:
    source = make(tmp_path, dataset, ready=False)
    folder = make(tmp_path, dataset, ready=True)
    assert recognise(source) == recognise(folder) and recognise(folder).ready


@pytest.mark.parametrize("dataset", ["rpg", "hku", "vector", "tumvie", "mvsec"])
def test_the_other_side_is_raw_until_it_is_preprocessed(dataset: str, tmp_path: Path) -> None:
    folder = make(tmp_path, dataset, ready=True)
    with pytest.raises(InputError, match=rf"{dataset} .*lacks .*right.*--side left"):
        recognise(folder, side="right")
    for file in sorted(tmp_path.rglob("*left*"), key=lambda path: len(path.parts), reverse=True):
        file.rename(file.with_name(file.name.replace("left", "right")))
    found = recognise(folder, side="right")
    assert (found.dataset, found.side, found.ready) == (dataset, "right", True)


@pytest.mark.parametrize("dataset", ["rpg", "vector", "mvsec"])
def test_the_other_side_is_made_from_the_raw_files(dataset: str, tmp_path: Path) -> None:
    folder = make(tmp_path, dataset, ready=True)
    make(tmp_path, dataset, ready=False)
    for file in sorted(tmp_path.rglob("seq1.synced.left_*")):
        file.rename(file.with_name(file.name.replace("left", "right")))
    found = recognise(folder, side="right")
    assert not found.ready and found.command.endswith("--side right")


@pytest.mark.parametrize("form", ["{seq}", "{seq}/", "{around}", "{around}/", "{relative}", "{relative}/", "."])
def test_forms_of_a_path(form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With and without trailing slash, relative and absolute, the sequence nested in a folder of its name."""
    make(tmp_path / "seq", "vector", ready=True)
    inner = tmp_path / "seq" / "seq"
    monkeypatch.chdir(tmp_path if "relative" in form else inner)
    path = form.format(seq=inner, around=tmp_path / "seq", relative="seq")
    assert recognise(path).path == inner
    assert recognise(path, dataset="vector").path == inner


def test_the_folder_of_the_same_name_goes_before_other_sub_folders(tmp_path: Path) -> None:
    for name in ("walk", "other"):
        (tmp_path / "walk" / name).mkdir(parents=True)
        (tmp_path / "walk" / name / "events.npz").touch()
        (tmp_path / "walk" / name / "calib.yaml").touch()
    assert recognise(tmp_path / "walk").path == tmp_path / "walk" / "walk"


def test_the_only_sub_folder_that_qualifies_is_taken(tmp_path: Path) -> None:
    make(tmp_path, "fpv", ready=True)
    (tmp_path / "notes").mkdir()
    (tmp_path / "0_calib").mkdir()
    assert recognise(tmp_path).path == tmp_path / "seq"


def test_several_sequences_are_listed(tmp_path: Path) -> None:
    make(tmp_path, "fpv", ready=True)
    (tmp_path / "seq").rename(tmp_path / "first")
    make(tmp_path, "eds", ready=True)
    with pytest.raises(AmbiguousError, match=r"several sequences.*first \(fpv\).*seq \(eds\)"):
        recognise(tmp_path)
    assert recognise(tmp_path, dataset="eds").path == tmp_path / "seq"


def test_a_folder_that_is_two_data_sets_at_once_is_ambiguous(tmp_path: Path) -> None:
    folder = make(tmp_path, "fpv", ready=True)
    make(tmp_path, "ecd", ready=True)
    with pytest.raises(AmbiguousError, match=r"\(fpv\).*\(ecd\)"):
        recognise(folder)
    assert recognise(folder, dataset="ecd").dataset == "ecd"


def test_several_bags_are_listed(tmp_path: Path) -> None:
    make(tmp_path, "rpg", ready=False)
    (tmp_path / "seq.bag").rename(tmp_path / "other.bag")
    make(tmp_path, "rpg", ready=False)
    with pytest.raises(AmbiguousError, match=r"other.bag \(rpg\).*seq.bag \(rpg\)"):
        recognise(tmp_path)
    assert recognise(tmp_path / "other.bag").path == tmp_path / "other"


def test_a_bag_of_another_camera_is_a_recording_of_ones_own(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "mine.bag", {"/dvs/events": [random_events(5)]})
    assert recognise(bag) == Recognised("generic", bag, "left", ("mine.bag",), (), bag)
    (tmp_path / "calib.yaml").touch()
    assert recognise(tmp_path).dataset == "generic"
    with pytest.raises(InputError, match="no raw recording of rpg"):
        recognise(bag, dataset="rpg")


def test_a_torn_bag_is_named(tmp_path: Path) -> None:
    (tmp_path / "torn.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(InputError, match=r"torn\.bag.*damaged"):
        recognise(tmp_path)


def test_rpg_planes_need_no_map(tmp_path: Path) -> None:
    folder = make(tmp_path, "rpg", ready=True)
    (folder / "rectify_map_left.h5").unlink()
    with pytest.raises(InputError, match=r"rpg .*lacks rectify_map_left\.h5"):
        recognise(folder)
    assert recognise(folder.rename(tmp_path / "simulation_3planes")).dataset == "rpg"


@pytest.mark.parametrize("gone", ["rectify_map_left.h5", "tss_imgs_us_left.txt"])
def test_an_incomplete_folder_says_what_is_missing_and_what_makes_it(gone: str, tmp_path: Path) -> None:
    folder = make(tmp_path, "vector", ready=True)
    (folder / gone).unlink()
    with pytest.raises(InputError, match=rf"vector .*lacks {gone}; `python scripts/pp_vector.py --indir {folder}"
                                         r"` makes it, once there is .*timestamp\.txt, \.\./0_calib/ or 0_calib/"):
        recognise(folder)


def test_own_recordings(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    with pytest.raises(InputError, match=r"not recognised.*needs an event file.*calib\.yaml.*has neither"):
        recognise(folder)
    (folder / "walk.raw").touch()
    with pytest.raises(InputError, match=r"has only walk\.raw"):
        recognise(folder)
    assert recognise(folder, calibrated=True).found == ("walk.raw",)
    (folder / "calib.json").touch()
    assert recognise(folder).found == ("walk.raw", "calib.json")


def test_a_missing_calibration_is_not_looked_for_in_a_sub_folder(tmp_path: Path) -> None:
    (tmp_path / "events.npz").touch()
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "events.npz").touch()
    (tmp_path / "old" / "calib.yaml").touch()
    with pytest.raises(InputError, match=r"has only events\.npz"):
        recognise(tmp_path)


def test_missing_paths_suggest_what_is_there(tmp_path: Path) -> None:
    (tmp_path / "board_slow.bag").touch()
    with pytest.raises(InputError, match=r"does not exist.*did you mean board_slow\.bag"):
        recognise(tmp_path / "board_slow")
    with pytest.raises(InputError, match="'nosuch' has no layout"):
        recognise(tmp_path, dataset="nosuch")


def test_ecd_can_be_read_as_a_recording_of_ones_own(tmp_path: Path) -> None:
    """The Event Camera Dataset has the files that recordings of one's own have, so there are two ways to read it."""
    folder = make(tmp_path, "ecd", ready=False)
    with pytest.raises(InputError, match=r"pp_ecd\.py.*or read it .*--dataset generic"):
        recognise(folder).require_ready()
    assert recognise(folder, dataset="generic").found == ("events.txt", "calib.txt")


def test_sequences_open_without_naming_the_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "walk" / "walk"
    folder.mkdir(parents=True)
    events = random_events(3000)
    np.savez(folder / "events.npz", x=events.x, y=events.y, t=events.t_us, p=events.p)
    (folder / "calib.yaml").write_text("width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n"
                                       "distortion_model: none\n")
    monkeypatch.chdir(tmp_path)
    opened = [open_sequence(name, path) for name in ("auto", "generic") for path in ("walk", "walk" + os.sep, folder)]
    assert {(one.name, one.width) for one in opened} == {("walk", 64)}
    first = [next(iter(one.voxels()))[0] for one in opened[:2]]
    assert (first[0] == first[1]).all() and first[0].abs().sum() > 0
    with pytest.raises(InputError, match="known are: auto, "):
        open_sequence("nosuch", folder)


def test_raw_folders_are_refused_with_the_command(tmp_path: Path) -> None:
    folder = make(tmp_path, "fpv", ready=False)
    with pytest.raises(InputError, match=r"is fpv by its .*python scripts/pp_fpv\.py --indir"):
        open_sequence("auto", folder)
