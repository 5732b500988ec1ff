"""The table of preprocessors and the runner: search, resuming, parallel work, failures, files of the shared formats."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from devo.errors import DevoError, InputError, OutputError
from tests.utils.raw_layouts.recording import random_recording
from tests.utils.raw_layouts.text_folders import write_ecd
from utils.calibration import Calibration
from utils.preprocessing import PREPROCESSORS, PreprocessOptions, Preprocessor, find_sequences, preprocess, register
from utils.preprocessing.products import Products, pinhole_text, read_raw_image
from utils.preprocessing.registry import walk_folders
from utils.undistort import rectify_map

CAMERA = Calibration(32, 24, 30.0, 30.0, 15.5, 11.5, "radtan", (-0.2, 0.05, 0.001, -0.002))


def find_raw(root: Path, side: str) -> list[Path]:
    return walk_folders(root, lambda folder: (folder / "raw.txt").is_file()) if root.is_dir() else []


def run_raw(folder: Path, options: PreprocessOptions) -> list[Path]:
    """Copy raw.txt; fail where it says so."""
    products = Products(options)
    text = (folder / "raw.txt").read_text()
    if text.startswith("fail"):
        raise {"input": InputError, "disk": OutputError}[text.split()[1]](f"{folder}: {text}")
    if products.missing(folder / "copy.txt"):
        products.text(folder / "copy.txt", f"{options.side} {text}")
    return products.made


@pytest.fixture
def dataset() -> Iterator[str]:
    register(Preprocessor("test_only", "folders with raw.txt", find_raw, run_raw, lambda folder, side: []))
    yield "test_only"
    del PREPROCESSORS["test_only"]


def add(root: Path, name: str, text: str) -> Path:
    (root / name).mkdir(parents=True)
    (root / name / "raw.txt").write_text(text)
    return root / name


def test_every_row_of_the_table_is_complete() -> None:
    assert {"fpv", "rpg", "ecd", "hku"} <= set(PREPROCESSORS)
    for name, row in PREPROCESSORS.items():
        assert row.name == name and row.layout and set(row.sides) <= {"left", "right"}
        assert row.find_sequences(Path("/nowhere/at/all"), "left") == []
        assert all(isinstance(path, Path) for path in row.outputs(Path("/nowhere/walk"), "left"))
    with pytest.raises(InputError, match="registered twice"):
        register(PREPROCESSORS["fpv"])


def test_all_sequences_are_found_and_complete_ones_are_kept(dataset: str, tmp_path: Path) -> None:
    first, second = add(tmp_path, "b/one", "1"), add(tmp_path, "a", "2")
    add(tmp_path, "a/inside", "not searched"), add(tmp_path, ".hidden", "not searched")
    (tmp_path / "loop").symlink_to(tmp_path)
    assert preprocess(dataset, tmp_path) == {second: [second / "copy.txt"], first: [first / "copy.txt"]}
    before = (first / "copy.txt").stat().st_mtime_ns
    (second / "copy.txt").unlink()
    assert preprocess(dataset, str(tmp_path) + os.sep, side="right") == {second: [second / "copy.txt"], first: []}
    assert (first / "copy.txt").stat().st_mtime_ns == before
    assert preprocess(dataset, first, side="right", overwrite=True) == {first: [first / "copy.txt"]}
    assert (first / "copy.txt").read_text() == "right 1"


def test_linked_recordings_are_found(dataset: str, tmp_path: Path) -> None:
    add(tmp_path / "disk", "walk", "1")
    (tmp_path / "datasets").mkdir()
    (tmp_path / "datasets" / "mine").symlink_to(tmp_path / "disk")
    assert find_sequences(dataset, tmp_path / "datasets")[1] == [tmp_path / "datasets" / "mine" / "walk"]


def test_a_failure_is_named_after_the_others_were_done(dataset: str, tmp_path: Path) -> None:
    bad = add(tmp_path, "a", "fail input")
    good = add(tmp_path, "b", "2")
    with pytest.raises(InputError, match=f"1 of 2 recordings failed: {bad}: fail input$"):
        preprocess(dataset, tmp_path)
    assert (good / "copy.txt").is_file()
    worse = add(tmp_path, "c", "fail disk")
    with pytest.raises(DevoError, match=f"2 of 3 recordings failed: {bad}: fail input; {worse}: fail disk") as caught:
        preprocess(dataset, tmp_path)
    assert caught.value.exit_code == 1, "not all failures are the input's"


def test_what_cannot_be_searched(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no recording of test_only found, expected folders with raw.txt"):
        preprocess(dataset, tmp_path)
    with pytest.raises(InputError, match="does not exist, expected recordings of test_only"):
        preprocess(dataset, tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"'kitti' has no preprocessor, known are: .*fpv"):
        preprocess("kitti", tmp_path)
    with pytest.raises(InputError, match="side is 'top'"):
        preprocess(dataset, tmp_path, side="top")
    with pytest.raises(InputError, match="recordings of ecd have one camera"):
        preprocess("ecd", tmp_path, side="right")
    add(tmp_path, "a", "1")
    with pytest.raises(InputError, match="jobs is 0"):
        preprocess(dataset, tmp_path, jobs=0)


def test_parallel_work(tmp_path: Path) -> None:
    """Two sequences in two processes; one of them cannot be used and does not stop the other."""
    few = random_recording(start_us=0, count=50)
    write_ecd(tmp_path, few, "200 200 120 90 -0.3 0.1 0 0 0", "good")
    bad = write_ecd(tmp_path, few, "200 200 120 90", "plain")
    with pytest.raises(InputError, match=f"1 of 2 recordings failed: {bad}.*no distortion coefficients"):
        preprocess("ecd", tmp_path, jobs=4)
    assert (tmp_path / "good" / "rectify_map.h5").is_file()
    assert not (bad / "rectify_map.h5").exists()


def test_a_killed_process_is_explained(dataset: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Killed(contextlib.nullcontext):
        """A pool whose processes die at once."""

        def submit(self, *arguments: object) -> Future:
            future: Future = Future()
            future.set_exception(BrokenProcessPool())
            return future

    monkeypatch.setattr("utils.preprocessing.runner.ProcessPoolExecutor", lambda *_, **__: Killed(Killed()))
    add(tmp_path, "a", "1"), add(tmp_path, "b", "2")
    with pytest.raises(DevoError, match="was killed, probably for want of memory; run the command again with fewer"):
        preprocess(dataset, tmp_path, jobs=2)


def test_formats_of_products(tmp_path: Path) -> None:
    products = Products(PreprocessOptions())
    intrinsics = products.pinhole(tmp_path / "calib.txt", CAMERA)
    text = (tmp_path / "calib.txt").read_text()
    assert [float(word) for word in text.split(" ")] == intrinsics.tolist() and "\n" not in text
    assert pinhole_text([1, 2.5, 1e-3, 4]) == "1.0 2.5 0.001 4.0"
    products.map(tmp_path / "map.h5", CAMERA, intrinsics)
    with h5py.File(tmp_path / "map.h5") as stream:
        assert list(stream) == ["rectify_map"] and stream["rectify_map"].dtype == np.dtype("<f4")
        assert np.array_equal(stream["rectify_map"][()], rectify_map(CAMERA)[0])
        assert stream["rectify_map"].compression is None and stream["rectify_map"].chunks is None
    products.table(tmp_path / "stamps.txt", np.array([5, 7]), "%d")
    assert (tmp_path / "stamps.txt").read_text() == "5\n7\n"
    products.table(tmp_path / "poses.txt", np.array([[0.1, 2.0], [1 / 3, 4.0]]), header="# a b")
    assert (tmp_path / "poses.txt").read_text() == "# a b\n0.1 2.0\n0.3333333333333333 4.0\n"
    assert [path.name for path in products.made] == ["calib.txt", "map.h5", "stamps.txt", "poses.txt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in products.made)


def test_a_camera_that_exists_decides_about_the_map(tmp_path: Path) -> None:
    """A folder from an older OpenCV keeps its intrinsics, and what is made for it fits to them."""
    (tmp_path / "calib.txt").write_text("25.0 26.0 15.0 12.0")
    products = Products(PreprocessOptions())
    intrinsics = products.pinhole(tmp_path / "calib.txt", CAMERA)
    assert intrinsics.tolist() == [25, 26, 15, 12]
    products.map(tmp_path / "map.h5", CAMERA, intrinsics)
    with h5py.File(tmp_path / "map.h5") as stream:
        assert np.array_equal(stream["rectify_map"][()], rectify_map(CAMERA, intrinsics=[25, 26, 15, 12])[0])
    anew = Products(PreprocessOptions(overwrite=True)).pinhole(tmp_path / "calib.txt", CAMERA)
    assert anew.tolist() != intrinsics.tolist()
    (tmp_path / "calib.txt").unlink()
    again = Products(PreprocessOptions())
    new = again.pinhole(tmp_path / "calib.txt", CAMERA)
    again.map(tmp_path / "map.h5", CAMERA, new)
    assert [path.name for path in again.made] == ["calib.txt", "map.h5"], "the map of the lost camera is of no use"
    with h5py.File(tmp_path / "map.h5") as stream:
        assert np.array_equal(stream["rectify_map"][()], rectify_map(CAMERA)[0])
    (tmp_path / "calib.txt").write_text("25.0 nan 15.0 12.0")
    with pytest.raises(InputError, match="fy is nan"):
        products.pinhole(tmp_path / "calib.txt", CAMERA)


def test_image_folders_appear_when_they_are_complete(tmp_path: Path) -> None:
    image = np.full((4, 6), 9, np.uint8)
    opened = []

    def images(count: int) -> Iterator[tuple[str, np.ndarray]]:
        opened.append(count)
        for number in range(count):
            yield f"{number:012d}.png", image
            if number == 3:
                raise InputError("image 4 is damaged")

    products = Products(PreprocessOptions())
    with pytest.raises(InputError, match="image 4 is damaged"):
        products.image_folder(tmp_path / "images", 5, lambda: images(5))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "000000000000.png").write_bytes(b"left by an interrupted run")
    products.image_folder(tmp_path / "images", 3, lambda: images(3))
    assert sorted(path.name for path in (tmp_path / "images").iterdir()) == [f"{i:012d}.png" for i in range(3)]
    products.image_folder(tmp_path / "images", 3, lambda: images(3))
    Products(PreprocessOptions(images=False)).image_folder(tmp_path / "other", 3, lambda: images(3))
    assert opened == [5, 3] and not (tmp_path / "other").exists()
    with pytest.raises(OutputError, match="cannot write"):
        products.image_folder(tmp_path / "none", 1, lambda: iter([("no_folder/a.png", image)]))


def test_raw_images_keep_their_channels(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "gray.png"), np.full((4, 6), 9, np.uint8))
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 6), 900, np.uint16))
    assert read_raw_image(tmp_path / "gray.png").shape == (4, 6)
    with pytest.raises(InputError, match="uint16, expected 8 bits"):
        read_raw_image(tmp_path / "deep.png")
    with pytest.raises(InputError, match="missing or damaged"):
        read_raw_image(tmp_path / "none.png")
