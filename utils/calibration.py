"""Camera calibration: one dataclass, read from YAML, JSON or one line of text, checked on the way in."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import yaml

from devo.errors import InputError

DistortionModel = Literal["none", "radtan", "fisheye"]

_MODEL_NAMES: dict[str, DistortionModel] = {
    "none": "none", "pinhole": "none", "": "none",
    "radtan": "radtan", "plumb_bob": "radtan", "plumb-bob": "radtan", "radial-tangential": "radtan", "opencv": "radtan",
    "fisheye": "fisheye", "equidistant": "fisheye", "kannala_brandt": "fisheye", "kannala-brandt": "fisheye",
    "kannala_brandt4": "fisheye", "kb4": "fisheye", "opencv_fisheye": "fisheye",
}
_COEFFICIENT_COUNTS: dict[DistortionModel, tuple[int, ...]] = {"none": (0,), "radtan": (4, 5), "fisheye": (4,)}


@dataclass(frozen=True)
class Calibration:
    """Pinhole camera with lens distortion.

    Attributes:
        width, height: sensor size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels; (0, 0) is the centre of the top left pixel.
        distortion_model: "none"; "radtan" with k1 k2 p1 p2 [k3] (Brown-Conrady as in OpenCV); "fisheye" with k1..k4
            (Kannala-Brandt, equidistant).
        coefficients: the distortion coefficients, unitless.

    Raises:
        InputError: numbers that no camera has: not finite, focal length not positive, principal point outside
            the image, empty image, wrong number of coefficients.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion_model: DistortionModel = "none"
    coefficients: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, size in (("width", self.width), ("height", self.height)):
            if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or not 1 <= size <= 65536:
                raise InputError(f"calibration: {name} is {size!r}, expected a whole number of pixels, at least 1")
        for name in ("fx", "fy", "cx", "cy"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"calibration: {name} is {getattr(self, name)}, expected a finite number of pixels")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(f"calibration: focal length is fx={self.fx:g}, fy={self.fy:g}, expected positive pixels")
        if not (-0.5 <= self.cx <= self.width - 0.5 and -0.5 <= self.cy <= self.height - 0.5):
            raise InputError(f"calibration: the principal point ({self.cx:g}, {self.cy:g}) lies outside the image of "
                             f"{self.width}x{self.height} pixels; check the size and the order fx fy cx cy")
        if self.distortion_model not in _COEFFICIENT_COUNTS:
            raise InputError(f"calibration: distortion model is {self.distortion_model!r}, expected "
                             "none, radtan or fisheye")
        allowed = _COEFFICIENT_COUNTS[self.distortion_model]
        if len(self.coefficients) not in allowed:
            raise InputError(f"calibration: {len(self.coefficients)} coefficients for the model "
                             f"{self.distortion_model}, expected {' or '.join(map(str, allowed))}")
        if not all(math.isfinite(value) for value in self.coefficients):
            raise InputError(f"calibration: distortion coefficients are {list(self.coefficients)}, expected "
                             "finite numbers")

    @property
    def intrinsics(self) -> npt.NDArray[np.float64]:
        """`fx fy cx cy` as (4,) float64 in pixels."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def camera_matrix(self) -> npt.NDArray[np.float64]:
        """The (3, 3) float64 camera matrix in pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        """Whether rectification moves anything; a fisheye without coefficients still is no pinhole camera."""
        return self.distortion_model == "fisheye" or any(value != 0 for value in self.coefficients)

    def as_dict(self) -> dict[str, Any]:
        """Return the calibration with the keys that `read_calibration` accepts."""
        return {"width": int(self.width), "height": int(self.height), "fx": float(self.fx), "fy": float(self.fy),
                "cx": float(self.cx), "cy": float(self.cy), "distortion_model": self.distortion_model,
                "distortion_coefficients": [float(value) for value in self.coefficients]}


def read_calibration(path: str | os.PathLike[str], image_size: tuple[int, int] | None = None,
                     fallback_size: tuple[int, int] | None = None, *, camera: str = "cam0",
                     default_model: DistortionModel | None = None) -> Calibration:
    """Read a calibration file.

    `.yaml`, `.yml`, `.json`: `width height fx fy cx cy distortion_model distortion_coefficients`; instead of
    `fx fy cx cy` a list `intrinsics` or a `camera_matrix` (9 numbers, 3x3 or ROS `data`); instead of width and height
    `resolution: [width, height]` or ROS `image_width`, `image_height`. Of a Kalibr camchain, one camera is read.
    Any other ending: one line `fx fy cx cy [k1 k2 p1 p2 [k3]]`.

    Args:
        path: the file.
        image_size: (width, height); must agree with the file if that says a size, and is needed if it does not.
        fallback_size: (width, height) used only if neither `image_size` nor the file says it.
        camera: which camera of a Kalibr camchain.
        default_model: lens model of coefficients where the file does not name one.

    Raises:
        InputError: the file is missing, not readable as its format, incomplete or implausible (see `Calibration`).
    """
    path = Path(path)
    if path.suffix.lower() not in (".yaml", ".yml", ".json"):
        fields = _read_text(path)
    else:
        fields = _one_camera(path, read_mapping(path), camera)
    try:
        width, height = _choose_size(_size(fields), image_size, fallback_size)
        fx, fy, cx, cy = _intrinsics(fields)
        model, coefficients = _distortion(fields, default_model)
        return Calibration(width, height, fx, fy, cx, cy, model, coefficients)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _read_text(path: Path) -> dict[str, Any]:
    try:
        lines = [line.split("#")[0].replace(",", " ").split() for line in path.read_text("ascii").splitlines()]
        numbers = [float(token) for line in lines for token in line]
    except OSError as error:
        raise InputError(f"cannot read calibration {path}: {error.strerror or error}") from error
    except (UnicodeDecodeError, ValueError):
        raise InputError(f"{path}: expected numbers `fx fy cx cy [k1 k2 p1 p2 [k3]]`, found something else") from None
    if len(numbers) not in (4, 8, 9):
        raise InputError(f"{path}: {len(numbers)} numbers, expected 4, 8 or 9: fx fy cx cy [k1 k2 p1 p2 [k3]]")
    model = "radtan" if len(numbers) > 4 else "none"
    return {"intrinsics": numbers[:4], "distortion_model": model, "distortion_coefficients": numbers[4:]}


def read_mapping(path: Path) -> dict[str, Any]:
    """Read the keys and values of a JSON or YAML file, that of OpenCV included.

    Raises:
        InputError: the file is missing, damaged or holds something else.
    """
    try:
        text = path.read_text("utf-8")
    except OSError as error:
        raise InputError(f"cannot read calibration {path}: {error.strerror or error}") from error
    except UnicodeDecodeError:
        raise InputError(f"{path}: not a text file, expected a calibration") from None
    try:
        if path.suffix.lower() == ".json":
            fields = json.loads(text)
        else:  # OpenCV writes a version line and a tag that YAML readers do not know
            fields = yaml.safe_load(text.replace("%YAML:1.0", "").replace("!!opencv-matrix", ""))
    except (json.JSONDecodeError, yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{path}: not valid {path.suffix[1:]} ({' '.join(str(error).split())[:100]})") from None
    if not isinstance(fields, dict):
        raise InputError(f"{path}: expected keys such as width, height, fx, fy, cx, cy, found {type(fields).__name__}")
    return fields


def _one_camera(path: Path, fields: dict[str, Any], camera: str) -> dict[str, Any]:
    """Return the fields of one camera of a Kalibr camchain, or all fields of a file with one camera."""
    if not any(isinstance(fields.get(name), dict) for name in ("cam0", camera)):
        return fields
    if not isinstance(fields.get(camera), dict):
        raise InputError(f"{path}: no camera {camera}, found {', '.join(map(str, fields))}")
    return dict(fields[camera])


def flat_numbers(value: Any, name: str) -> list[float]:
    """Return a flat list of numbers from a number, a nested list or a ROS matrix with `data`.

    Raises:
        InputError: the value is something else.
    """
    if isinstance(value, dict):
        value = value.get("data")
    try:
        numbers = np.asarray(value, dtype=np.float64).ravel().tolist()
    except (TypeError, ValueError):
        raise InputError(f"calibration: {name} is {str(value)[:60]}, expected numbers") from None
    return [float(number) for number in numbers]


def _size(fields: dict[str, Any]) -> tuple[int, int] | None:
    size = fields.get("resolution", fields.get("image_size"))
    if size is None:
        size = [fields.get(name, fields.get(f"image_{name}")) for name in ("width", "height")]
        if all(value is None for value in size):
            return None
    numbers = flat_numbers(size, "image size")
    if len(numbers) != 2 or not all(math.isfinite(value) and value == int(value) for value in numbers):
        raise InputError(f"calibration: image size is {size}, expected whole numbers width and height")
    return int(numbers[0]), int(numbers[1])


def _choose_size(in_file: tuple[int, int] | None, given: tuple[int, int] | None,
                 fallback: tuple[int, int] | None) -> tuple[int, int]:
    if in_file is not None and given is not None and tuple(given) != in_file:
        raise InputError(f"calibration: made for {in_file[0]}x{in_file[1]} pixels, but the image size was given as "
                         f"{given[0]}x{given[1]}; one of the two is wrong")
    size = in_file or given or fallback
    if size is None:
        raise InputError("calibration: the sensor size is not in the file; pass the image size as width and height "
                         "(for example --image_size 346 260) or add width and height to a YAML calibration")
    return int(size[0]), int(size[1])


def _intrinsics(fields: dict[str, Any]) -> tuple[float, float, float, float]:
    if all(name in fields for name in ("fx", "fy", "cx", "cy")):
        numbers = flat_numbers([fields[name] for name in ("fx", "fy", "cx", "cy")], "fx fy cx cy")
    elif "intrinsics" in fields:
        numbers = flat_numbers(fields["intrinsics"], "intrinsics")
    elif "camera_matrix" in fields:
        numbers = flat_numbers(fields["camera_matrix"], "camera_matrix")
        if len(numbers) == 9:
            if numbers[1] != 0 or numbers[3:4] + numbers[6:] != [0.0, 0.0, 0.0, 1.0]:
                raise InputError(f"calibration: camera matrix {numbers} is not of the form fx 0 cx, 0 fy cy, 0 0 1")
            numbers = [numbers[0], numbers[4], numbers[2], numbers[5]]
    else:
        raise InputError("calibration: no intrinsics, found the keys "
                         f"{', '.join(map(str, list(fields)[:8])) or 'none'}; "
                         "expected fx, fy, cx, cy or intrinsics or camera_matrix")
    if len(numbers) != 4:
        raise InputError(f"calibration: {len(numbers)} intrinsics, expected 4: fx fy cx cy")
    return numbers[0], numbers[1], numbers[2], numbers[3]


def _distortion(fields: dict[str, Any],
                default_model: DistortionModel | None) -> tuple[DistortionModel, tuple[float, ...]]:
    values = fields.get("distortion_coefficients", fields.get("distortion_coeffs"))
    coefficients = tuple(flat_numbers(values, "distortion coefficients")) if values is not None else ()
    name = fields.get("distortion_model", default_model)
    if name is None:
        if any(coefficients):
            raise InputError("calibration: distortion coefficients without distortion_model; say radtan or fisheye")
        return "none", ()
    model = _MODEL_NAMES.get(str(name).lower())
    if model is None:
        raise InputError(f"calibration: distortion model is {name!r}, expected none, radtan (plumb_bob) or fisheye "
                         "(equidistant)")
    if model == "none" and not any(coefficients):
        coefficients = ()
    return model, coefficients
