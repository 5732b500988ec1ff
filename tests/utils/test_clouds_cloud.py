"""The point cloud container."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devo.errors import InputError
from utils.clouds.cloud import PointCloud
from utils.clouds.comments import metadata_from_comments, metadata_to_comments


def _cloud(count: int = 5) -> PointCloud:
    rng = np.random.default_rng(count)
    return PointCloud(
        rng.normal(size=(count, 3)),
        rng.integers(0, 256, (count, 3), dtype=np.uint8),
        {"host_frame": np.arange(count, dtype=np.int32), "depth": rng.random(count)},
        {"frame": "first camera", "run": str(count)},
    )


def test_points_become_contiguous_float32_and_the_input_stays() -> None:
    source = np.arange(12, dtype=np.float64).reshape(3, 4).T
    cloud = PointCloud(source)
    assert cloud.points.dtype == np.float32
    assert cloud.points.flags.c_contiguous
    np.testing.assert_array_equal(cloud.points, source)
    assert source.dtype == np.float64
    assert len(cloud) == 4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"points": np.zeros(3)}, r"\(N, 3\)"),
        ({"points": np.zeros((2, 4))}, r"\(2, 4\)"),
        ({"points": np.zeros((2, 3), complex)}, "complex"),
        ({"points": np.zeros((2, 3)), "colors": np.zeros((2, 3))}, "uint8"),
        ({"points": np.zeros((2, 3)), "colors": np.zeros((3, 3), np.uint8)}, r"\(3, 3\)"),
        ({"points": np.zeros((2, 3)), "scalars": {"depth": np.zeros(3)}}, "depth"),
        ({"points": np.zeros((2, 3)), "scalars": {"depth": np.zeros((2, 1))}}, "depth"),
        ({"points": np.zeros((2, 3)), "scalars": {"depth": np.array(["a", "b"])}}, "depth"),
        ({"points": np.zeros((2, 3)), "scalars": {"x": np.zeros(2)}}, "'x' is no name"),
        ({"points": np.zeros((2, 3)), "scalars": {"two words": np.zeros(2)}}, "two words"),
        ({"points": np.zeros((2, 3)), "metadata": {"seed": 1}}, "text to text"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PointCloud(**arguments)


def test_select_by_mask_indices_and_slice() -> None:
    cloud = _cloud()
    mask = np.array([True, False, True, False, True])
    for rows in (mask, np.array([0, 2, 4]), [0, 2, 4], slice(0, 5, 2)):
        part = cloud.select(rows)
        np.testing.assert_array_equal(part.points, cloud.points[mask])
        np.testing.assert_array_equal(part.colors, cloud.colors[mask])
        np.testing.assert_array_equal(part.scalars["host_frame"], [0, 2, 4])
        assert part.metadata == cloud.metadata
    assert len(cloud.select([])) == 0
    np.testing.assert_array_equal(cloud.select([3, 3, -1]).scalars["host_frame"], [3, 3, 4])


@pytest.mark.parametrize("rows", [np.ones(4, bool), [5], [-6], [[0]], [0.5]])
def test_select_refuses_what_is_no_row(rows: object) -> None:
    with pytest.raises(InputError):
        _cloud().select(rows)  # type: ignore[arg-type]


def test_concat_keeps_order_and_common_metadata() -> None:
    first, second = _cloud(3), _cloud(4)
    both = PointCloud.concat([first, second])
    np.testing.assert_array_equal(both.points, np.vstack([first.points, second.points]))
    np.testing.assert_array_equal(both.colors, np.vstack([first.colors, second.colors]))
    np.testing.assert_array_equal(both.scalars["host_frame"], [0, 1, 2, 0, 1, 2, 3])
    assert both.metadata == {"frame": "first camera"}
    assert len(PointCloud.concat([])) == 0


def test_concat_refuses_different_columns() -> None:
    with pytest.raises(InputError, match="cloud 1 has points only"):
        PointCloud.concat([_cloud(), PointCloud(np.zeros((1, 3)))])


def test_finite_mask() -> None:
    points = np.zeros((4, 3))
    points[1, 2], points[2, 0], points[3, 1] = np.nan, np.inf, 1e300  # the last one overflows float32
    np.testing.assert_array_equal(PointCloud(points).finite_mask(), [True, False, False, False])


KEYS = st.text(min_size=1, max_size=12).filter(lambda key: key != "comment")


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(KEYS, st.text(max_size=300), max_size=3))
def test_metadata_survives_comment_lines(metadata: dict[str, str]) -> None:
    lines = metadata_to_comments(metadata)
    assert all(line.isascii() and line.isprintable() and len(line) <= 202 for line in lines)
    assert metadata_from_comments(lines) == metadata


def test_foreign_comments_are_kept_together() -> None:
    lines = ["Created by Open3D", "TextureFile: C:\\Work", "VCGLIB generated"]
    metadata = metadata_from_comments(lines)
    assert metadata == {"TextureFile": "C:\\Work", "comment": "Created by Open3D\nVCGLIB generated"}
    assert metadata_from_comments(metadata_to_comments(metadata)) == metadata
